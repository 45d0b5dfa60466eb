"""MapTracker: a camera in a COLMAP map, found about once a second in a thread, carried by flow in every frame between."""

from dataclasses import replace

import cv2
import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.charuco.detector import NO_CORNERS, Corners, FrameHistory
from viewfinder.frames import CameraFrame, Pose
from viewfinder.tracking.charuco_tracker import Detections, DetectionThread
from viewfinder.tracking.map_localiser import MapLocaliser, MapPose, pose_in_map, pose_refined
from viewfinder.tracking.sparse_map import SparseMap
from viewfinder.tracking.tracker import TrackedPose

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
        self.localisation_s = 0.0

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
        self.localisation_s = detection.took_s
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
