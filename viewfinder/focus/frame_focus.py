"""FrameFocus: what came with the frame itself: Exif, gphoto2, the browser's focusDistance."""

from viewfinder.flow.frames import CameraFrame, LensState
from viewfinder.tracking.base import TrackedPose


class FrameFocus:
    """A FocusSource. hold_s: many cameras tell the focus with few frames; what was told last holds so long, then it is not known."""

    name = "the camera"

    def __init__(self, hold_s: float = 5.0) -> None:
        self._hold_s = hold_s
        self._told, self._told_s = LensState(), 0.0

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState:  # noqa: ARG002
        if frame.lens != LensState():
            self._told, self._told_s = frame.lens.completed_by(self._held(frame)), frame.captured_s
        return self._held(frame)

    def close(self) -> None:
        """Nothing to close."""

    def _held(self, frame: CameraFrame) -> LensState:
        return self._told if 0.0 <= frame.captured_s - self._told_s <= self._hold_s else LensState()
