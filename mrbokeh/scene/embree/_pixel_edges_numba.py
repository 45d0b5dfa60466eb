"""Finding pixels beside which something else begins. Compiled with numba."""

import numpy as np

from mrbokeh.scene._compiled_numba import compiled
from mrbokeh.scene._vectors_numba import dot, row


@compiled
def mark_edges(
    mesh: np.ndarray,
    alpha: np.ndarray,
    depth_m: np.ndarray,
    normal: np.ndarray,
    lit: np.ndarray,
    directions: np.ndarray,
    width: int,
    steps: np.ndarray,
    edges: np.ndarray,
) -> None:
    """See `edge_pixels`. All arrays are flat, row after row. steps: of shares, relative of depth, cosine. edges: bool, written."""
    share_step, depth_step, least_cosine = steps[0], steps[1], steps[2]
    count = mesh.size
    for here in range(count):
        column = here % width
        for side in range(4):
            right = 1 if side == 0 else side - 2
            there = here + (0 if side == 0 else width) + right
            if there >= count or column + right < 0 or column + right >= width:
                continue
            differs = mesh[here] != mesh[there] or abs(alpha[here] - alpha[there]) > share_step or abs(lit[here] - lit[there]) > share_step
            if not differs and mesh[here] >= 0 and (side == 0 or right == 0):
                # The neighbour's ray meets this pixel's tangent plane at the depth that is expected of it.
                own = row(normal, here)
                expected_m = depth_m[here] * dot(own, row(directions, here)) / dot(own, row(directions, there))
                near_enough = abs(depth_m[there] - expected_m) < depth_step * min(depth_m[here], depth_m[there])
                differs = not (near_enough and dot(own, row(normal, there)) > least_cosine)
            if differs:
                edges[here] = True
                edges[there] = True
