"""Any tracker, with its poses smoothed if that is switched on. Off, they pass as they are: a pose solved from the frame it is
shown over needs no smoothing, and any smoothing makes the object lag behind the plate."""

from dataclasses import replace

from mrbokeh.optics.camera import Camera
from viewfinder.flow.frames import CameraFrame
from viewfinder.tracking.base import TrackedPose, Tracker
from viewfinder.tracking.one_euro import OneEuroPose


class SmoothedTracker:
    """smoothing: may be switched at any time, from another thread."""

    def __init__(self, tracker: Tracker, smoothing: bool = False, pivot_m: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        self.tracker, self.smoothing, self.name = tracker, smoothing, tracker.name
        self._filter = OneEuroPose(pivot_m=pivot_m)

    def track(self, frame: CameraFrame, intrinsics: Camera) -> TrackedPose | None:
        tracked = self.tracker.track(frame, intrinsics)
        if tracked is None or not tracked.is_certain or not self.smoothing:
            self._filter.reset()
            return tracked
        return replace(tracked, camera_from_world=self._filter(tracked.camera_from_world, tracked.captured_s))

    def close(self) -> None:
        self.tracker.close()
