"""Poses of a camera from points of a plane and where it sees them, and how exact they are.

A plane seen from far away or head on has two poses that fit almost alike (Collins and Bartoli 2014, IPPE gives both). Both are refined
and given, with how well they fit and how exact each is; `pose_branches` tells them apart over time.

Exactness is the scatter of the corners, carried to the rotation (Gauss-Newton covariance). Foreshortening goes with the cosine of a tilt,
so that near head on it tells a tilt less and less. A pose may by chance be tilted more than the board; its own derivatives then promise
too much, and those of a pose nearer to head on are looked at, too.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera

_PARAMETERS = 6
_EXPECTED_PX = 0.3
_EXPECTED_WEIGHT = 12
"""Prior scatter of corners, and for how many coordinates it counts: few corners fit well by chance, and those that are
aligned with the print, or carried by flow, share errors that a residual does not show."""

_BACK_SIGMAS = 2.0
_HEAD_ON = 1e-6

Points = Float64[np.ndarray, "points 3"]
Pose = Float64[np.ndarray, "4 4"]


def corner_sigma_px(residual_px: float, points: int) -> float:
    """Return the error of one coordinate of a corner, from the RMS distance that the best pose leaves."""
    squares = points * residual_px**2 + _EXPECTED_WEIGHT * _EXPECTED_PX**2
    return float(np.sqrt(squares / (2 * points - _PARAMETERS + _EXPECTED_WEIGHT)))


def turn_sigma_rad(points_m: Points, camera: Camera, pose: Pose, sigma_px: float) -> float:
    """Return the RMS angle by which corners that scatter by sigma_px turn a pose; inf if they leave it open."""
    seen = points_m @ pose[:3, :3].T + pose[:3, 3]
    sigma_rad = _sigma_rad(seen, camera, sigma_px)
    if not np.isfinite(sigma_rad):
        return sigma_rad
    return max(sigma_rad, _sigma_rad(_towards_head_on(seen, pose[:3, 2], _BACK_SIGMAS * sigma_rad), camera, sigma_px))


def _towards_head_on(seen: Points, normal: Float64[np.ndarray, "3"], at_most_rad: float) -> Points:
    """Turn points about their middle until the plane lies across the line of sight, or as far as allowed."""
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
    """Return derivatives of the pixel by the point in camera axes."""
    x, y, z = seen.T
    nothing, (fx, fy) = np.zeros_like(z), camera.focal_px
    return np.stack([np.stack([fx / z, nothing, -fx * x / z**2], 1), np.stack([nothing, fy / z, -fy * y / z**2], 1)], axis=1)


def _cross_matrices(arms: Points) -> Float64[np.ndarray, "points 3 3"]:
    """Return for each vector a the matrix A with A w = a x w."""
    x, y, z = arms.T
    nothing = np.zeros_like(x)
    rows = ((nothing, -z, y), (z, nothing, -x), (-y, x, nothing))
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


FEWEST_POINTS = 6
"""Fewest points of a pose: with fewer, near the limit of defocus, poses were off by degrees."""

_SAME_RAD = 0.01
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-10)

PointsM = Float64[np.ndarray, "points 3"]
PointsPx = Float64[np.ndarray, "points 2"]


@dataclass(frozen=True)
class PlanePose:
    """Pose that may explain the points of a plane.

    camera_from_world: (4, 4). residual_px: RMS distance over the inliers. turn_sigma_rad: of its rotation, if it is the right one.

    misfit: sum of squared distances over the variance of a corner, of which a wrong pose has more.
    """

    camera_from_world: Pose
    residual_px: float
    turn_sigma_rad: float
    misfit: float


@dataclass(frozen=True)
class PlanePoses:
    """Poses of a plane: one or two, the best fit first."""

    poses: tuple[PlanePose, ...]
    inliers: Bool[np.ndarray, " points"]


def largest_residual_px(camera: Camera) -> float:
    """Return the distance beyond which a point is wrong, as is a pose with an RMS of half as much: 3 px of 1280, never below 1.5."""
    return max(1.5, 3.0 * camera.width_px / 1280)


def poses_from_plane(points_m: PointsM, xy_px: PointsPx, camera: Camera) -> PlanePoses | None:
    """Return the poses that explain points_m (z = 0); None if fewer than 6 points agree on one. camera: intrinsics."""
    wrong_px = largest_residual_px(camera)
    inliers = _of_one_plane(points_m, xy_px, wrong_px)
    found = _fit(points_m, xy_px, inliers, camera)
    if found is None:
        return None
    near = _off_px(points_m, xy_px, camera, found.poses[0].camera_from_world) < wrong_px
    if (near != inliers).any():
        found = _fit(points_m, xy_px, near, camera)
    return found if found is not None and found.poses[0].residual_px < wrong_px / 2 else None


def _fit(points_m: PointsM, xy_px: PointsPx, inliers: Bool[np.ndarray, " points"], camera: Camera) -> PlanePoses | None:
    points_m, xy_px = points_m[inliers], xy_px[inliers]
    if len(points_m) < FEWEST_POINTS or _on_a_line(points_m):
        return None
    fits = [(_rms(_off_px(points_m, xy_px, camera, pose)), pose) for pose in _refined_poses(points_m, xy_px, camera)]
    if not fits:
        return None
    fits = _apart(sorted(fits, key=lambda fit: fit[0]))
    sigma_px = corner_sigma_px(fits[0][0], len(points_m))
    poses = [
        PlanePose(pose, rms_px, turn_sigma_rad(points_m, camera, pose, sigma_px), len(points_m) * (rms_px / sigma_px) ** 2)
        for rms_px, pose in fits
    ]
    return PlanePoses(tuple(poses), inliers)


def _of_one_plane(points_m: PointsM, xy_px: PointsPx, wrong_px: float) -> Bool[np.ndarray, " points"]:
    """Return which points one homography explains (MAGSAC++, Barath et al. 2020)."""
    if len(points_m) < FEWEST_POINTS:
        return np.zeros(len(points_m), bool)
    _, mask = cv2.findHomography(points_m[:, :2], xy_px, cv2.USAC_MAGSAC, wrong_px)
    return np.zeros(len(points_m), bool) if mask is None else mask.ravel().astype(bool)


def _on_a_line(points_m: PointsM) -> bool:
    spread = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    return bool(spread[1] < 0.02 * spread[0])


def _refined_poses(points_m: PointsM, xy_px: PointsPx, camera: Camera) -> list[Pose]:
    matrix = opencv_matrix(camera)
    _, turns, shifts, _ = cv2.solvePnPGeneric(points_m, xy_px, matrix, None, flags=cv2.SOLVEPNP_IPPE)
    poses = [
        _pose(*cv2.solvePnPRefineLM(points_m, xy_px, matrix, None, turn.copy(), shift.copy(), _STOP))
        for turn, shift in zip(turns, shifts, strict=True)
    ]
    return [pose for pose in poses if _before_camera(points_m, pose)]


def _apart(fits: list[tuple[float, Pose]]) -> list[tuple[float, Pose]]:
    """Return the best fit, and the best of those that refinement did not lead to the same pose."""
    others = [fit for fit in fits[1:] if turn_between_rad(fit[1], fits[0][1]) > _SAME_RAD]
    return [fits[0], *others[:1]]


def opencv_matrix(camera: Camera) -> Float64[np.ndarray, "3 3"]:
    """Return intrinsics for positions whose first pixel has its centre at (0.5, 0.5): the convention cancels, as both sides keep it."""
    return np.array([[camera.focal_px[0], 0, camera.principal_px[0]], [0, camera.focal_px[1], camera.principal_px[1]], [0, 0, 1]])


def _pose(turn: np.ndarray, shift: np.ndarray) -> Pose:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return pose


def _before_camera(points_m: PointsM, pose: Pose) -> bool:
    return bool(np.isfinite(pose).all() and (points_m @ pose[2, :3] + pose[2, 3] > 0).all())


def turn_between_rad(one: Pose, other: Pose) -> float:
    """Return the angle between two rotations."""
    return float(np.linalg.norm(cv2.Rodrigues(one[:3, :3] @ other[:3, :3].T)[0]))


def _off_px(points_m: PointsM, xy_px: PointsPx, camera: Camera, pose: Pose) -> Float64[np.ndarray, " points"]:
    in_camera = points_m @ pose[:3, :3].T + pose[:3, 3]
    seen = in_camera[:, :2] / in_camera[:, 2:] * camera.focal_px + camera.principal_px
    return np.linalg.norm(seen - xy_px, axis=1)


def _rms(off_px: np.ndarray) -> float:
    return float(np.sqrt(np.mean(off_px**2)))
