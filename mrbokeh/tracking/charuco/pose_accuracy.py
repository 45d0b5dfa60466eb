"""How exact a pose from points of a plane is: the scatter of its corners, carried to its rotation (Gauss-Newton covariance).

Foreshortening goes with the cosine of a tilt, so that near head on it tells a tilt less and less. A pose may by chance be tilted more
than the board; its own derivatives then promise too much, and those of a pose nearer to head on are looked at, too.
"""

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera

_PARAMETERS = 6
_EXPECTED_PX = 0.3
_EXPECTED_WEIGHT = 12
"""What corners scatter by before any is seen, and for how many coordinates that counts: few corners fit well by chance, and those that are
aligned with the print, or carried by flow, share errors that a residual does not show."""

_BACK_SIGMAS = 2.0
_HEAD_ON = 1e-6

Points = Float64[np.ndarray, "points 3"]
Pose = Float64[np.ndarray, "4 4"]


def corner_sigma_px(residual_px: float, points: int) -> float:
    """Of one coordinate of a corner, from the RMS distance that the best pose leaves."""
    squares = points * residual_px**2 + _EXPECTED_WEIGHT * _EXPECTED_PX**2
    return float(np.sqrt(squares / (2 * points - _PARAMETERS + _EXPECTED_WEIGHT)))


def turn_sigma_rad(points_m: Points, camera: Camera, pose: Pose, sigma_px: float) -> float:
    """RMS angle by which corners that scatter by sigma_px turn a pose; inf where they leave it open."""
    seen = points_m @ pose[:3, :3].T + pose[:3, 3]
    sigma_rad = _sigma_rad(seen, camera, sigma_px)
    if not np.isfinite(sigma_rad):
        return sigma_rad
    return max(sigma_rad, _sigma_rad(_towards_head_on(seen, pose[:3, 2], _BACK_SIGMAS * sigma_rad), camera, sigma_px))


def _towards_head_on(seen: Points, normal: Float64[np.ndarray, "3"], at_most_rad: float) -> Points:
    """Turned about their middle until the plane lies across the line of sight, or as far as allowed."""
    middle = seen.mean(axis=0)
    sight = middle / np.linalg.norm(middle) * np.sign(middle @ normal or 1.0)
    axis = np.cross(normal, sight)
    sine = float(np.linalg.norm(axis))
    if sine < _HEAD_ON:
        return seen
    turn = Rotation.from_rotvec(axis / sine * min(np.arcsin(min(sine, 1.0)), at_most_rad))
    return np.asarray(turn.apply(seen - middle) + middle)


def _sigma_rad(seen: Points, camera: Camera, sigma_px: float) -> float:
    by_place = _by_place(seen, camera)
    arms = seen - seen.mean(axis=0)
    # A turn w about the middle moves a point by w x arm; a shift moves it by as much, whatever it is (in distances, to be of one size).
    by_turn = -np.einsum("nij,njk->nik", by_place, _cross_matrices(arms))
    jacobian = np.concatenate([by_turn, by_place * seen[:, 2].mean()], axis=2).reshape(-1, _PARAMETERS)
    try:
        covariance = np.linalg.inv(jacobian.T @ jacobian)
    except np.linalg.LinAlgError:
        return float("inf")
    return sigma_px * float(np.sqrt(np.trace(covariance[:3, :3])))


def _by_place(seen: Points, camera: Camera) -> Float64[np.ndarray, "points 2 3"]:
    """Derivatives of the pixel by the point in camera axes."""
    x, y, z = seen.T
    nothing, (fx, fy) = np.zeros_like(z), camera.focal_px
    return np.stack([np.stack([fx / z, nothing, -fx * x / z**2], 1), np.stack([nothing, fy / z, -fy * y / z**2], 1)], axis=1)


def _cross_matrices(arms: Points) -> Float64[np.ndarray, "points 3 3"]:
    """Of each vector a the matrix A with A w = a x w."""
    x, y, z = arms.T
    nothing = np.zeros_like(x)
    rows = ((nothing, -z, y), (z, nothing, -x), (-y, x, nothing))
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)
