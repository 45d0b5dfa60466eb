"""Parts of the viewfinder that do what a test tells: a camera, a tracker, and detections without a thread."""

from collections.abc import Callable, Iterator
from threading import Event

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.charuco.detector import Grey
from viewfinder.frames import CameraFrame
from viewfinder.tracking.charuco_tracker import Detection, Detector
from viewfinder.tracking.tracker import TrackedPose


class ToldCamera:
    """A FrameSource whose frames a generator gives. It is called with the event that asks for its end."""

    transfer, status = "srgb", None

    def __init__(self, frames: Callable[[Event], Iterator[CameraFrame]], name: str = "camera 7") -> None:
        self.frames, self.name = frames, name


class ToldTracker:
    """A Tracker whose poses a function of the frame gives. sizes: of the cameras that came with the frames."""

    name = "told"

    def __init__(self, pose_of: Callable[[CameraFrame], TrackedPose | None]) -> None:
        self.pose_of, self.closed, self.sizes = pose_of, False, set[tuple[int, int]]()

    def track(self, frame: CameraFrame, intrinsics: Camera) -> TrackedPose | None:
        self.sizes.add((intrinsics.width_px, intrinsics.height_px))
        return self.pose_of(frame)

    def close(self) -> None:
        self.closed = True


class ImmediateDetections:
    """Detections that search every nth frame offered while the caller waits, so that every run gives the same."""

    def __init__(self, detector: Detector, every: int = 1) -> None:
        self._detector, self._every, self._offered = detector, every, 0
        self._found: Detection | None = None

    def offer(self, sequence: int, grey: Grey, hurry: bool) -> None:
        self._offered += 1
        if hurry or (self._offered - 1) % self._every == 0:
            self._found = Detection(sequence, self._detector.detect(grey))

    def take(self) -> Detection | None:
        found, self._found = self._found, None
        return found

    def close(self) -> None:
        """Nothing runs."""
