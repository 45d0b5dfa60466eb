"""Whether meshes are others moved as one rigid body: then what was prepared for those serves for these."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.scene.mesh import Mesh

_SAMPLES = 256
_PLACE_TOLERANCE = 2.0**-24
"""Of the extent: half of what rounding to float32, the precision of the ray tracer, changes at most."""
_NORMAL_TOLERANCE = 1e-5


def rigid_motion(before: Sequence[Mesh], after: Sequence[Mesh]) -> Float64[np.ndarray, "4 4"] | None:
    """(4, 4) after_from_before, or None where anything but a common motion without scaling changed.

    Meshes count as the same where they share triangles, texture coordinates, colours and material as objects, as
    `Mesh.transformed` leaves them; then every vertex, normal and tangent is checked.
    """
    if len(before) != len(after) or not all(map(_shares_all_but_place, before, after)):
        return None
    if all(one is other for one, other in zip(before, after, strict=True)):
        return np.eye(4)
    motion = _fitted(_sampled(before), _sampled(after))
    return motion if all(_is_moved(one, other, motion) for one, other in zip(before, after, strict=True)) else None


def _shares_all_but_place(one: Mesh, other: Mesh) -> bool:
    shared = one.triangles is other.triangles and one.uvs is other.uvs and one.colors is other.colors and one.material is other.material
    same_tangents = (one.tangents is None) == (other.tangents is None)
    return shared and same_tangents and len(one.positions_m) == len(other.positions_m)


def _sampled(meshes: Sequence[Mesh]) -> Float64[np.ndarray, "points 3"]:
    points_m = [mesh.positions_m[:: max(1, len(mesh.positions_m) * len(meshes) // _SAMPLES)] for mesh in meshes]
    return np.concatenate(points_m).astype(np.float64)


def _fitted(before_m: Float64[np.ndarray, "points 3"], after_m: Float64[np.ndarray, "points 3"]) -> Float64[np.ndarray, "4 4"]:
    """The rotation and shift of least squares (Kabsch 1976)."""
    middle_before, middle_after = before_m.mean(0), after_m.mean(0)
    left, _, right = np.linalg.svd((after_m - middle_after).T @ (before_m - middle_before))
    keeps_hands = np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    motion = np.eye(4)
    motion[:3, :3] = left @ keeps_hands @ right
    motion[:3, 3] = middle_after - motion[:3, :3] @ middle_before
    return motion


def _is_moved(one: Mesh, other: Mesh, motion: Float64[np.ndarray, "4 4"]) -> bool:
    """Whether `other` is `one` under this motion, in all that shading looks at."""
    turn = motion[:3, :3]
    tolerance_m = _PLACE_TOLERANCE * float(np.ptp(one.positions_m, axis=0).max(initial=0.0))
    if np.abs(one.positions_m @ turn.T + motion[:3, 3] - other.positions_m).max(initial=0.0) > tolerance_m:
        return False
    if not _is_turned(one.normals, other.normals, turn):
        return False
    if one.tangents is None or other.tangents is None:
        return True
    return _is_turned(one.tangents[:, :3], other.tangents[:, :3], turn) and np.array_equal(one.tangents[:, 3], other.tangents[:, 3])


def _is_turned(one: Float32[np.ndarray, "n 3"], other: Float32[np.ndarray, "n 3"], turn: Float64[np.ndarray, "3 3"]) -> bool:
    return float(np.abs(one @ turn.T.astype(np.float32) - other).max(initial=0.0)) < _NORMAL_TOLERANCE
