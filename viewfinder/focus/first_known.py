"""FirstKnown: several sources of the focus in order; each value comes from the first that knows it."""

from collections.abc import Sequence

from viewfinder.flow.frames import CameraFrame, LensState
from viewfinder.focus.base import FocusSource
from viewfinder.tracking.base import TrackedPose


class FirstKnown:
    """A FocusSource over others (`focus.base.FocusSource`).

    focus_from: the name of the source that the focus distance of the last frame came from, None if nobody knew.
    """

    def __init__(self, sources: Sequence[FocusSource]) -> None:
        self._sources = tuple(sources)
        self.name = ", else ".join(source.name for source in sources)
        self.focus_from: str | None = None

    def state(self, frame: CameraFrame, pose: TrackedPose | None) -> LensState:
        """All are asked, so that those which learn from every frame see it."""
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
