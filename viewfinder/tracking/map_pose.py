"""The pose of a camera from points of a map that lie anywhere, by pycolmap: LO-RANSAC without a pose before, robust refinement with."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import MissingExtraError
from viewfinder.flow.frames import Pose

FEWEST_POINTS = 12
"""With fewer, wrong matches agree on a pose now and then."""

_WRONG_PX = 4.0
_ROUNDS = 2

PointsM = Float64[np.ndarray, "points 3"]
PointsPx = Float64[np.ndarray, "points 2"]


@dataclass(frozen=True)
class MapPose:
    """residual_px: RMS distance over the inliers."""

    camera_from_world: Pose
    residual_px: float
    inliers: Bool[np.ndarray, " points"]


def pose_in_map(points_m: PointsM, xy_px: PointsPx, camera: Camera) -> MapPose | None:
    """From nothing; None if fewer than 12 points agree."""
    if len(points_m) < FEWEST_POINTS:
        return None
    pycolmap = require_pycolmap()
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = _wrong_px(camera)
    options.ransac.random_seed = 0
    found = pycolmap.estimate_and_refine_absolute_pose(xy_px, points_m, _colmap_camera(camera), options)
    return None if found is None else _judged(found["cam_from_world"], points_m, xy_px, camera)


def pose_refined(points_m: PointsM, xy_px: PointsPx, camera: Camera, before: Pose) -> MapPose | None:
    """From the pose of the frame before, with Cauchy's loss; None if fewer than 12 points agree with it."""
    pycolmap = require_pycolmap()
    pose = pycolmap.Rigid3d(before[:3])
    off_px = _off_px(points_m, xy_px, camera, before)
    # The camera has moved since: what lies far from all others is out, and then what lies far.
    for limit_px in (max(3.0 * float(np.median(off_px, keepdims=False)), _wrong_px(camera)) if len(off_px) else 0.0, _wrong_px(camera)):
        inliers = off_px < limit_px
        if np.count_nonzero(inliers) < FEWEST_POINTS:
            return None
        found = pycolmap.refine_absolute_pose(pose, xy_px, points_m, inliers, _colmap_camera(camera))
        if found is None:
            return None
        pose = found["cam_from_world"]
        off_px = _off_px(points_m, xy_px, camera, _matrix(pose))
    return _judged(pose, points_m, xy_px, camera)


def require_pycolmap() -> Any:
    try:
        import pycolmap
    except ImportError:
        raise MissingExtraError("pycolmap", "capture") from None
    return pycolmap


def _judged(pose: Any, points_m: PointsM, xy_px: PointsPx, camera: Camera) -> MapPose | None:
    matrix = _matrix(pose)
    off_px = _off_px(points_m, xy_px, camera, matrix)
    inliers = off_px < _wrong_px(camera)
    if np.count_nonzero(inliers) < FEWEST_POINTS:
        return None
    return MapPose(matrix, float(np.sqrt(np.mean(off_px[inliers] ** 2))), inliers)


def _wrong_px(camera: Camera) -> float:
    """4 px in a picture whose longer side is 1280 px; never below 1.5."""
    return max(1.5, _WRONG_PX * max(camera.width_px, camera.height_px) / 1280)


def _colmap_camera(camera: Camera) -> Any:
    """COLMAP's pixels are ours."""
    return require_pycolmap().Camera(
        model="PINHOLE", width=camera.width_px, height=camera.height_px, params=[*camera.focal_px, *camera.principal_px]
    )


def _matrix(pose: Any) -> Pose:
    return np.vstack([np.asarray(pose.matrix(), np.float64), [0.0, 0.0, 0.0, 1.0]])


def _off_px(points_m: PointsM, xy_px: PointsPx, camera: Camera, pose: Pose) -> Float64[np.ndarray, " points"]:
    """inf for what lies behind the camera."""
    in_camera = points_m @ pose[:3, :3].T + pose[:3, 3]
    depth_m = np.where(in_camera[:, 2] > 0.0, in_camera[:, 2], np.nan)
    seen = in_camera[:, :2] / depth_m[:, None] * camera.focal_px + camera.principal_px
    return np.nan_to_num(np.linalg.norm(seen - xy_px, axis=1), nan=np.inf)
