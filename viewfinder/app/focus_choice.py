"""Who says where the lens is focused, and in which order they are asked."""

from collections.abc import Callable, Sequence

from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.tracking.charuco.board import CharucoBoard
from viewfinder.focus.board_focus import BlurOfBoardFocus, FollowingOptics
from viewfinder.focus.sources import FirstKnown, FocusSource, FrameFocus, ManualFocus, TrackedLensFocus
from viewfinder.tracking.socket_tracker import SocketTracker
from viewfinder.tracking.tracker import Tracker

BY_DEFAULT = ("hand", "tracking", "source")
FOCUS_SOURCES = (*BY_DEFAULT, "board")
"""The page; the tracking system; what comes with the frames; the blur of the board, which is asked only if it is named."""


def open_focus(manual: ManualFocus, tracker: Tracker | None, first: Sequence[str] = (), blur: FocusSource | None = None) -> FirstKnown:
    """first: names of FOCUS_SOURCES that are asked before the others, which follow in the order of BY_DEFAULT. blur: of the board."""
    known: dict[str, FocusSource] = {"hand": manual, "source": FrameFocus()}
    if isinstance(tracker, SocketTracker):
        known["tracking"] = TrackedLensFocus(tracker)
    if blur is not None:
        known["board"] = blur
    return FirstKnown([known[name] for name in dict.fromkeys((*first, *BY_DEFAULT)) if name in known])


def blur_of_board(board: CharucoBoard, lens: Lens, optics: Callable[[], tuple[Lens, Camera] | None]) -> FollowingOptics:
    """lens: until `optics` tells another one; see `FollowingOptics`."""
    nominal = Camera(640, 360, (lens.focal_px(640),) * 2, (320.0, 180.0))
    return FollowingOptics(BlurOfBoardFocus(board, lens, nominal), optics)
