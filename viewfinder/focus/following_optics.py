"""FollowingOptics: the focus from the blur of the board, with the lens and the f-number that the page was told last."""

from collections.abc import Callable

from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from viewfinder.flow.frames import CameraFrame, LensState
from viewfinder.focus.blur_of_board_focus import BlurOfBoardFocus
from viewfinder.tracking.base import TrackedPose


class FollowingOptics:
    """A FocusSource. optics: the lens and the intrinsics of the last picture, None before the first; asked with every frame."""

    def __init__(self, blur: BlurOfBoardFocus, optics: Callable[[], tuple[Lens, Camera] | None]) -> None:
        self.blur, self.name, self._optics = blur, blur.name, optics

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState:
        now = self._optics()
        if now is None:
            return LensState()
        self.blur.follow(*now)
        return self.blur.state(frame, pose)

    def close(self) -> None:
        self.blur.close()
