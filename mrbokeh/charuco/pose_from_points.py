"""The pose of a camera from points of a plane and where it sees them.

A plane seen from far away or head on has two poses that fit almost alike (Collins and Bartoli 2014, IPPE gives both). Both are
refined, and of two that fit alike the one nearer to the pose before is taken.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from mrbokeh.camera import Camera

FEWEST_POINTS = 6
"""With fewer, near the limit of defocus, poses were off by degrees."""

_ALIKE = 1.1
_ALIKE_PX = 0.03
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-10)

Pose = Float64[np.ndarray, "4 4"]
PointsM = Float64[np.ndarray, "points 3"]
PointsPx = Float64[np.ndarray, "points 2"]


@dataclass(frozen=True)
class PoseFit:
    """camera_from_world: (4, 4). residual_px: RMS distance over the inliers."""

    camera_from_world: Pose
    residual_px: float
    inliers: Bool[np.ndarray, " points"]


def largest_residual_px(camera: Camera) -> float:
    """Beyond it a point is wrong, and so is a pose with an RMS of half as much: 3 px in a picture of 1280, never below 1.5."""
    return max(1.5, 3.0 * camera.width_px / 1280)


def pose_from_plane(points_m: PointsM, xy_px: PointsPx, camera: Camera, before: Pose | None = None) -> PoseFit | None:
    """points_m: z = 0. camera: intrinsics. before: the pose of the frame before. None if fewer than 6 points agree on a pose."""
    wrong_px = largest_residual_px(camera)
    inliers = _of_one_plane(points_m, xy_px, wrong_px)
    fit = _fit(points_m, xy_px, inliers, camera, before)
    if fit is None:
        return None
    near = _off_px(points_m, xy_px, camera, fit.camera_from_world) < wrong_px
    if (near != inliers).any():
        fit = _fit(points_m, xy_px, near, camera, fit.camera_from_world)
    return fit if fit is not None and fit.residual_px < wrong_px / 2 else None


def _fit(points_m: PointsM, xy_px: PointsPx, inliers: Bool[np.ndarray, " points"], camera: Camera, before: Pose | None) -> PoseFit | None:
    if np.count_nonzero(inliers) < FEWEST_POINTS or _on_a_line(points_m[inliers]):
        return None
    pose = _refined_pose(points_m[inliers], xy_px[inliers], camera, before)
    return None if pose is None else PoseFit(pose, _rms(_off_px(points_m[inliers], xy_px[inliers], camera, pose)), inliers)


def _of_one_plane(points_m: PointsM, xy_px: PointsPx, wrong_px: float) -> Bool[np.ndarray, " points"]:
    """Those that one homography explains (MAGSAC++, Barath et al. 2020)."""
    if len(points_m) < FEWEST_POINTS:
        return np.zeros(len(points_m), bool)
    _, mask = cv2.findHomography(points_m[:, :2], xy_px, cv2.USAC_MAGSAC, wrong_px)
    return np.zeros(len(points_m), bool) if mask is None else mask.ravel().astype(bool)


def _on_a_line(points_m: PointsM) -> bool:
    spread = np.linalg.svd(points_m - points_m.mean(axis=0), compute_uv=False)
    return bool(spread[1] < 0.02 * spread[0])


def _refined_pose(points_m: PointsM, xy_px: PointsPx, camera: Camera, before: Pose | None) -> Pose | None:
    matrix = opencv_matrix(camera)
    _, turns, shifts, _ = cv2.solvePnPGeneric(points_m, xy_px, matrix, None, flags=cv2.SOLVEPNP_IPPE)
    starts = list(zip(turns, shifts, strict=True)) + ([] if before is None else [(_turn(before), before[:3, 3:])])
    poses = [_pose(*cv2.solvePnPRefineLM(points_m, xy_px, matrix, None, turn.copy(), shift.copy(), _STOP)) for turn, shift in starts]
    fits = [(_rms(_off_px(points_m, xy_px, camera, pose)), pose) for pose in poses if _before_camera(points_m, pose)]
    if not fits:
        return None
    least_px = min(residual_px for residual_px, _ in fits)
    alike = [(residual_px, pose) for residual_px, pose in fits if residual_px <= _ALIKE * least_px + _ALIKE_PX]
    if before is None:
        return min(alike, key=lambda fit: fit[0])[1]
    return min(alike, key=lambda fit: _turn_rad(fit[1], before))[1]


def opencv_matrix(camera: Camera) -> Float64[np.ndarray, "3 3"]:
    """Intrinsics for positions whose first pixel has its centre at (0.5, 0.5): the convention cancels, as both sides keep it."""
    return np.array([[camera.focal_px[0], 0, camera.principal_px[0]], [0, camera.focal_px[1], camera.principal_px[1]], [0, 0, 1]])


def _pose(turn: np.ndarray, shift: np.ndarray) -> Pose:
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], shift.ravel()
    return pose


def _before_camera(points_m: PointsM, pose: Pose) -> bool:
    return bool(np.isfinite(pose).all() and (points_m @ pose[2, :3] + pose[2, 3] > 0).all())


def _turn(pose: Pose) -> Float64[np.ndarray, "3 1"]:
    """As a rotation vector."""
    return np.asarray(cv2.Rodrigues(pose[:3, :3])[0], np.float64)


def _turn_rad(one: Pose, other: Pose) -> float:
    return float(np.linalg.norm(cv2.Rodrigues(one[:3, :3] @ other[:3, :3].T)[0]))


def _off_px(points_m: PointsM, xy_px: PointsPx, camera: Camera, pose: Pose) -> Float64[np.ndarray, " points"]:
    in_camera = points_m @ pose[:3, :3].T + pose[:3, 3]
    seen = in_camera[:, :2] / in_camera[:, 2:] * camera.focal_px + camera.principal_px
    return np.linalg.norm(seen - xy_px, axis=1)


def _rms(off_px: np.ndarray) -> float:
    return float(np.sqrt(np.mean(off_px**2)))
