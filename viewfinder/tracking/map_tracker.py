"""MapTracker: a camera in a COLMAP map, found about once a second in a thread, carried by flow in every frame between.

It is found by MapLocaliser: SIFT of a frame matched with what the map's points look like, verified by pycolmap. `pose_in_map` solves a
pose from nothing (LO-RANSAC), `pose_refined` from the pose of the frame before (robust refinement).
"""

from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.charuco.detector import NO_CORNERS, Corners, FrameHistory, Grey
from viewfinder.frames import CameraFrame, Pose
from viewfinder.tracking.charuco_tracker import Detections, DetectionThread
from viewfinder.tracking.sparse_map import SparseMap, find_features, require_pycolmap
from viewfinder.tracking.tracker import TrackedPose

FEWEST_POINTS = 12
"""With fewer, wrong matches agree on a pose now and then."""

_WRONG_PX = 4.0
_ROUNDS = 2

PointsM = Float64[np.ndarray, "points 3"]
PointsPx = Float64[np.ndarray, "points 2"]


@dataclass(frozen=True)
class MapPose:
    """Pose in a map. residual_px: RMS distance over the inliers."""

    camera_from_world: Pose
    residual_px: float
    inliers: Bool[np.ndarray, " points"]


def pose_in_map(points_m: PointsM, xy_px: PointsPx, camera: Camera) -> MapPose | None:
    """Solve a pose from nothing; None if fewer than 12 points agree."""
    if len(points_m) < FEWEST_POINTS:
        return None
    pycolmap = require_pycolmap()
    options = pycolmap.AbsolutePoseEstimationOptions()
    options.ransac.max_error = _wrong_px(camera)
    options.ransac.random_seed = 0
    found = pycolmap.estimate_and_refine_absolute_pose(xy_px, points_m, _colmap_camera(camera), options)
    return None if found is None else _judged(found["cam_from_world"], points_m, xy_px, camera)


def pose_refined(points_m: PointsM, xy_px: PointsPx, camera: Camera, before: Pose) -> MapPose | None:
    """Refine the pose of the frame before, with Cauchy's loss; None if fewer than 12 points agree with it."""
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


def _judged(pose: Any, points_m: PointsM, xy_px: PointsPx, camera: Camera) -> MapPose | None:
    matrix = _matrix(pose)
    off_px = _off_px(points_m, xy_px, camera, matrix)
    inliers = off_px < _wrong_px(camera)
    if np.count_nonzero(inliers) < FEWEST_POINTS:
        return None
    return MapPose(matrix, float(np.sqrt(np.mean(off_px[inliers] ** 2))), inliers)


def _wrong_px(camera: Camera) -> float:
    """Return the limit of inliers: 4 px in a picture whose longer side is 1280 px; never below 1.5."""
    return max(1.5, _WRONG_PX * max(camera.width_px, camera.height_px) / 1280)


def _colmap_camera(camera: Camera) -> Any:
    """Return the camera for pycolmap, whose pixels are ours."""
    return require_pycolmap().Camera(
        model="PINHOLE", width=camera.width_px, height=camera.height_px, params=[*camera.focal_px, *camera.principal_px]
    )


def _matrix(pose: Any) -> Pose:
    return np.vstack([np.asarray(pose.matrix(), np.float64), [0.0, 0.0, 0.0, 1.0]])


def _off_px(points_m: PointsM, xy_px: PointsPx, camera: Camera, pose: Pose) -> Float64[np.ndarray, " points"]:
    """Return distances in px; inf for what lies behind the camera."""
    in_camera = points_m @ pose[:3, :3].T + pose[:3, 3]
    depth_m = np.where(in_camera[:, 2] > 0.0, in_camera[:, 2], np.nan)
    seen = in_camera[:, :2] / depth_m[:, None] * camera.focal_px + camera.principal_px
    return np.nan_to_num(np.linalg.norm(seen - xy_px, axis=1), nan=np.inf)


_FEATURES = 1200
_AT_ONCE = 256
_LOWES_RATIO = 0.85


@dataclass(frozen=True)
class Localisation:
    """Camera found in a map.

    camera_from_map: metres. points: those of the map that were found, and where. matches: how many there were before verification.
    """

    camera_from_map: Pose
    points: Corners
    matches: int


class MapLocaliser:
    """Detector for a DetectionThread. camera: intrinsics, which follow the size of the frame; may be replaced at any time."""

    def __init__(self, sparse_map: SparseMap, camera: Camera) -> None:
        self.map, self.camera = sparse_map, camera

    def detect(self, grey: Grey) -> Corners:
        found = self.localise(grey)
        return NO_CORNERS if found is None else found.points

    def localise(self, grey: Grey) -> Localisation | None:
        """Find the camera; None where too few points agree on a pose."""
        camera = self.camera.resized(grey.shape[1], grey.shape[0])
        features = find_features(grey, _FEATURES)
        if not len(features.xy_px):
            return None
        feature, point = matches(features.descriptors, self.map)
        xy_px = features.xy_px[feature]
        fit = pose_in_map(self.map.points_m[point], xy_px, camera)
        if fit is None:
            return None
        return Localisation(fit.camera_from_world, Corners(point, xy_px).only(fit.inliers), len(feature))


Numbers = Int64[np.ndarray, " matches"]


def matches(descriptors: Float32[np.ndarray, "features 128"], sparse_map: SparseMap) -> tuple[Numbers, Numbers]:
    """Match (features, points): each feature's nearest point, by its nearest look, where the next point is clearly farther (Lowe's ratio);
    of several features that claim one point the nearest.
    """
    starts = np.flatnonzero(np.diff(sparse_map.point_of, prepend=-1))
    if len(starts) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    nearest, distances = _nearest(descriptors, sparse_map, starts)
    clear = np.flatnonzero(distances[:, 0] < _LOWES_RATIO * distances[:, 1])
    by_distance = clear[np.argsort(distances[clear, 0], kind="stable")]
    points, first = np.unique(nearest[by_distance], return_index=True)
    return by_distance[first].astype(np.int64), points.astype(np.int64)


def _nearest(
    descriptors: Float32[np.ndarray, "features 128"], sparse_map: SparseMap, starts: Int64[np.ndarray, " points"]
) -> tuple[Int64[np.ndarray, " features"], Float64[np.ndarray, "features 2"]]:
    """Return (nearest point, distances to it and to the next point); vectors of length 1 are the nearer the larger their product."""
    nearest, products = [], []
    for first in range(0, len(descriptors), _AT_ONCE):
        alike = np.maximum.reduceat(descriptors[first : first + _AT_ONCE] @ sparse_map.descriptors.T, starts, axis=1)
        two = np.argpartition(-alike, 1, axis=1)[:, :2]
        largest = np.take_along_axis(alike, two, axis=1)
        nearest.append(two[np.arange(len(two)), largest.argmax(axis=1)])
        products.append(-np.sort(-largest, axis=1))
    distances = np.sqrt(np.maximum(2.0 - 2.0 * np.concatenate(products).astype(np.float64), 0.0))
    return np.concatenate(nearest).astype(np.int64), distances


LOCALISE_EVERY_S = 1.0
GRACE_S = 0.25
_MOST_POINTS = 150
_ENOUGH_POINTS = 60
_FRAMES_KEPT = 45  # a localisation may take so many
_GOOD_RESIDUAL_PX = 1.5


class MapTracker:
    """Tracker in a map. map_from_world: where our world lies in the map, in metres.

    detections: who localises, on which frames; a DetectionThread unless given. points: those that made the last pose. grace_s: for
    so long after the track is lost the last pose is given again, with its own time and falling quality.
    """

    name = "map"

    def __init__(
        self,
        localiser: MapLocaliser,
        map_from_world: Pose | None = None,
        detections: Detections | None = None,
        grace_s: float = GRACE_S,
    ) -> None:
        self._localiser, self._grace_s = localiser, grace_s
        self._map_from_world = np.eye(4) if map_from_world is None else map_from_world
        self._detections = detections or DetectionThread(localiser, LOCALISE_EVERY_S)
        self._history = FrameHistory(_FRAMES_KEPT)
        self._pose_in_map: Pose | None = None
        self._last: TrackedPose | None = None
        self.points = NO_CORNERS

    def track(self, frame: CameraFrame, intrinsics: Camera) -> TrackedPose | None:
        self._localiser.camera = intrinsics
        grey = cv2.cvtColor(frame.bgr, cv2.COLOR_BGR2GRAY)
        if not self._history.add(frame.sequence, grey):
            self.points, self._pose_in_map = NO_CORNERS, None
        self._detections.offer(frame.sequence, grey, hurry=self._pose_in_map is None)
        points = self._newest_points()
        fit = self._pose(points, intrinsics)
        if fit is None:
            self.points, self._pose_in_map = NO_CORNERS, None
            return self._held(frame.captured_s)
        self.points, self._pose_in_map = points.only(fit.inliers), fit.camera_from_world
        pose = fit.camera_from_world @ self._map_from_world
        self._last = TrackedPose(
            camera_from_world=pose,
            quality=self._quality(fit),
            captured_s=frame.captured_s,
            residual_px=fit.residual_px,
            points=len(self.points),
        )
        return self._last

    def close(self) -> None:
        self._detections.close()

    @property
    def _map(self) -> SparseMap:
        return self._localiser.map

    def _newest_points(self) -> Corners:
        """Return what was localised, carried to this frame, before what flowed here; no more than are needed."""
        flowed = self._history.from_before(self.points)
        detection = self._detections.take()
        if detection is None:
            return flowed
        found = self._history.carry(_spread(detection.corners), detection.sequence)
        return flowed if found is None or len(found) < len(flowed) // 2 else _spread(found.with_more(flowed))

    def _pose(self, points: Corners, intrinsics: Camera) -> MapPose | None:
        """Solve from the pose before where that holds, else from nothing."""
        points_m = self._map.points_m[points.ids]
        if self._pose_in_map is not None:
            refined = pose_refined(points_m, points.xy_px, intrinsics, self._pose_in_map)
            if refined is not None and 2 * len(points) < 3 * np.count_nonzero(refined.inliers):
                return refined
        return pose_in_map(points_m, points.xy_px, intrinsics)

    def _held(self, now_s: float) -> TrackedPose | None:
        if self._last is None or now_s - self._last.captured_s > self._grace_s:
            self._last = None
            return None
        share = 1.0 - (now_s - self._last.captured_s) / self._grace_s
        return replace(self._last, quality=self._last.quality * share)

    def _quality(self, fit: MapPose) -> float:
        """Return 1 for 60 points that fit to the pixel."""
        exact = 1.0 / (1.0 + (fit.residual_px / _GOOD_RESIDUAL_PX) ** 2)
        return float(min(len(self.points) / _ENOUGH_POINTS, 1.0) * exact)


def _spread(points: Corners) -> Corners:
    """Keep at most 150, every nth: their numbers come from many pictures, so that these lie all over the frame."""
    if len(points) <= _MOST_POINTS:
        return points
    keep = np.zeros(len(points), bool)
    keep[np.linspace(0, len(points) - 1, _MOST_POINTS).round().astype(int)] = True
    return points.only(keep)
