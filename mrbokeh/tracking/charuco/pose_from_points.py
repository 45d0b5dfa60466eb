"""The poses of a camera from points of a plane and where it sees them.

A plane seen from far away or head on has two poses that fit almost alike (Collins and Bartoli 2014, IPPE gives both). Both are refined
and given, with how well they fit and how exact each is; `pose_branches` tells them apart over time.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.charuco.pose_accuracy import corner_sigma_px, turn_sigma_rad

FEWEST_POINTS = 6
"""With fewer, near the limit of defocus, poses were off by degrees."""

_SAME_RAD = 0.01
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-10)

Pose = Float64[np.ndarray, "4 4"]
PointsM = Float64[np.ndarray, "points 3"]
PointsPx = Float64[np.ndarray, "points 2"]


@dataclass(frozen=True)
class PlanePose:
    """camera_from_world: (4, 4). residual_px: RMS distance over the inliers. turn_sigma_rad: of its rotation, if it is the right one.

    misfit: sum of squared distances over the variance of a corner, of which a wrong pose has more.
    """

    camera_from_world: Pose
    residual_px: float
    turn_sigma_rad: float
    misfit: float


@dataclass(frozen=True)
class PlanePoses:
    """poses: one or two, the best fit first."""

    poses: tuple[PlanePose, ...]
    inliers: Bool[np.ndarray, " points"]


def largest_residual_px(camera: Camera) -> float:
    """Beyond it a point is wrong, and so is a pose with an RMS of half as much: 3 px in a picture of 1280, never below 1.5."""
    return max(1.5, 3.0 * camera.width_px / 1280)


def poses_from_plane(points_m: PointsM, xy_px: PointsPx, camera: Camera) -> PlanePoses | None:
    """points_m: z = 0. camera: intrinsics. None if fewer than 6 points agree on a pose."""
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
    """Those that one homography explains (MAGSAC++, Barath et al. 2020)."""
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
    """The best, and the best of those that refinement did not lead to the same pose."""
    others = [fit for fit in fits[1:] if turn_between_rad(fit[1], fits[0][1]) > _SAME_RAD]
    return [fits[0], *others[:1]]


def opencv_matrix(camera: Camera) -> Float64[np.ndarray, "3 3"]:
    """Intrinsics for positions whose first pixel has its centre at (0.5, 0.5): the convention cancels, as both sides keep it."""
    return np.array([[camera.focal_px[0], 0, camera.principal_px[0]], [0, camera.focal_px[1], camera.principal_px[1]], [0, 0, 1]])


def _pose(turn: np.ndarray, shift: np.ndarray) -> Pose:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return pose


def _before_camera(points_m: PointsM, pose: Pose) -> bool:
    return bool(np.isfinite(pose).all() and (points_m @ pose[2, :3] + pose[2, 3] > 0).all())


def turn_between_rad(one: Pose, other: Pose) -> float:
    """The angle between two rotations."""
    return float(np.linalg.norm(cv2.Rodrigues(one[:3, :3] @ other[:3, :3].T)[0]))


def _off_px(points_m: PointsM, xy_px: PointsPx, camera: Camera, pose: Pose) -> Float64[np.ndarray, " points"]:
    in_camera = points_m @ pose[:3, :3].T + pose[:3, 3]
    seen = in_camera[:, :2] / in_camera[:, 2:] * camera.focal_px + camera.principal_px
    return np.linalg.norm(seen - xy_px, axis=1)


def _rms(off_px: np.ndarray) -> float:
    return float(np.sqrt(np.mean(off_px**2)))
