"""TrackedLensFocus: the lens as an external tracking system tells it (OpenTrackIO; FreeD through a lens table)."""

from viewfinder.flow.frames import CameraFrame, LensState
from viewfinder.tracking.base import TrackedPose
from viewfinder.tracking.tracking_socket import SocketTracker


class TrackedLensFocus:
    """A FocusSource; the time of the frame finds the state of the lens as it finds the pose. The tracker is closed as a tracker."""

    def __init__(self, tracker: SocketTracker) -> None:
        self.name = f"lens of {tracker.name}"
        self._tracker = tracker

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState:  # noqa: ARG002
        return self._tracker.lens(frame)

    def close(self) -> None:
        """Nothing of its own to close."""
