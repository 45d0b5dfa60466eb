"""Sources of the focus: a person, the frame, a tracking system; and FirstKnown, which asks them in order."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol, runtime_checkable

from mrbokeh.system.errors import InputError
from viewfinder.frames import CameraFrame, LensState
from viewfinder.options import FOCUS_BY_DEFAULT
from viewfinder.tracking.socket_tracker import SocketTracker
from viewfinder.tracking.tracker import TrackedPose, Tracker


@runtime_checkable
class FocusSource(Protocol):
    """Source of the focus, called with every frame that is composited; tells what it knows of the lens, None for the rest. Must be fast."""

    name: str

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState: ...

    def close(self) -> None: ...


class FirstKnown:
    """FocusSource over others, in order; each value comes from the first that knows it.

    focus_from: the name of the source that the focus distance of the last frame came from, None if nobody knew.
    """

    def __init__(self, sources: Sequence[FocusSource]) -> None:
        self._sources = tuple(sources)
        self.name = ", else ".join(source.name for source in sources)
        self.focus_from: str | None = None

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState:
        """Ask all sources, so that those which learn from every frame see it."""
        known = LensState()
        focus_from = None
        for source in self._sources:
            told = source.state(frame, pose)
            if known.focus_distance_m is None and told.focus_distance_m is not None:
                focus_from = source.name
            known = known.completed_by(told)
        self.focus_from = focus_from
        return known

    def close(self) -> None:
        for source in self._sources:
            source.close()


class FrameFocus:
    """FocusSource of what came with the frame: Exif, gphoto2, the browser. hold_s: what was told last holds so long."""

    name = "the camera"

    def __init__(self, hold_s: float = 5.0) -> None:
        self._hold_s = hold_s
        self._told, self._told_s = LensState(), 0.0

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState:  # noqa: ARG002
        if frame.lens != LensState():
            self._told, self._told_s = frame.lens.completed_by(self._held(frame)), frame.captured_s
        return self._held(frame)

    def close(self) -> None:
        """Close nothing: nothing runs."""

    def _held(self, frame: CameraFrame) -> LensState:
        return self._told if 0.0 <= frame.captured_s - self._told_s <= self._hold_s else LensState()


class ManualFocus:
    """FocusSource that a person sets. What nobody has set (None) comes from another source."""

    name = "by hand"

    def __init__(self, lens: LensState | None = None) -> None:
        self._lens = lens or LensState()

    def focus(self, distance_m: float | None) -> None:
        """Set the metres from the entrance pupil, inf is allowed; None hands the focus back to the other sources."""
        if distance_m is not None and not distance_m > 0.0:
            raise InputError(f"expected a focus distance of more than 0 m, got {distance_m} m")
        self._lens = replace(self._lens, focus_distance_m=distance_m)

    def set_f_number(self, f_number: float | None) -> None:
        """Set the f-number; None hands it back to the other sources."""
        if f_number is not None and not 0.3 <= f_number <= 256.0:
            raise InputError(f"expected an f-number between 0.3 and 256, got {f_number}")
        self._lens = replace(self._lens, f_number=f_number)

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState:  # noqa: ARG002
        return self._lens

    def close(self) -> None:
        """Close nothing: nothing runs."""


class TrackedLensFocus:
    """FocusSource of a tracking system; the time of the frame finds the lens as it finds the pose. It does not close the tracker."""

    def __init__(self, tracker: SocketTracker) -> None:
        self.name = f"lens of {tracker.name}"
        self._tracker = tracker

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState:  # noqa: ARG002
        return self._tracker.lens(frame)

    def close(self) -> None:
        """Close nothing: the tracker is closed as a tracker."""


def open_focus(manual: ManualFocus, tracker: Tracker | None, first: Sequence[str] = (), blur: FocusSource | None = None) -> FirstKnown:
    """Return the sources in the order in which they are asked: those named first, then FOCUS_BY_DEFAULT. blur: of the board."""
    known: dict[str, FocusSource] = {"hand": manual, "source": FrameFocus()}
    if isinstance(tracker, SocketTracker):
        known["tracking"] = TrackedLensFocus(tracker)
    if blur is not None:
        known["board"] = blur
    return FirstKnown([known[name] for name in dict.fromkeys((*first, *FOCUS_BY_DEFAULT)) if name in known])
