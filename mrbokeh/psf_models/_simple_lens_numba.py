"""Rays through a thin lens, compiled: each lands half a circle of confusion times its lens point away."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def opening_at(x: float, y: float, edges: np.ndarray, starts: np.ndarray, extent: float) -> float:
    """The weight of the opening at a lens point within `extent`: the signed weights of the edges that a ray to +x crosses.

    edges (E, 5): x0, y0, x1, y1 and the weight of what lies to the left of an edge that goes up (y1 > y0), with its sign
    turned for one that goes down; sorted into bands of equal height over -extent..extent, of which band b has those from
    starts[b] to starts[b + 1] (an edge is listed in every band that it touches).
    """
    bands = len(starts) - 1
    band = min(max(int((y + extent) * bands / (2.0 * extent)), 0), bands - 1)
    total = 0.0
    for index in range(starts[band], starts[band + 1]):
        x0, y0, x1, y1 = edges[index, 0], edges[index, 1], edges[index, 2], edges[index, 3]
        if (y0 > y) != (y1 > y) and x < x0 + (y - y0) * (x1 - x0) / (y1 - y0):
            total += edges[index, 4]
    return total


@njit(cache=True, nogil=True)
def trace_lens(
    kernel: np.ndarray, low_px: float, high_px: float, shares: np.ndarray, extent: float, edges: np.ndarray, starts: np.ndarray
) -> float:
    """Add rays (rays, 3) to kernel (K, K): lens points over the square of half width `extent`, diameters from low to high; their light."""
    size = kernel.shape[0]
    centre = 0.5 * size
    light = 0.0
    for ray in range(len(shares)):
        u = (2.0 * shares[ray, 0] - 1.0) * extent
        v = (2.0 * shares[ray, 1] - 1.0) * extent
        weight = opening_at(u, v, edges, starts, extent)
        if weight != 0.0:
            half_px = 0.5 * (low_px + (high_px - low_px) * shares[ray, 2])
            column, row = int(np.floor(centre + half_px * u)), int(np.floor(centre + half_px * v))
            if 0 <= row < size and 0 <= column < size:
                kernel[row, column] += weight
                light += weight
    return light
