"""Detection beside the stream: the newest frame is searched in a thread of its own, at most so often."""

import logging
from dataclasses import dataclass
from threading import Event, Thread
from time import monotonic
from typing import Protocol, runtime_checkable

from mrbokeh.tracking.charuco.detector import Corners, Grey
from viewfinder.flow.newest import Newest

_POLL_S = 0.1
_LEAVE_S = 3.0

log = logging.getLogger(__name__)


@runtime_checkable
class Detector(Protocol):
    def detect(self, grey: Grey) -> Corners: ...


@dataclass(frozen=True)
class Detection:
    """corners of the frame of that number; took_s: how long the search took."""

    sequence: int
    corners: Corners
    took_s: float = 0.0


@runtime_checkable
class Detections(Protocol):
    """Takes frames and gives, later or at once, what was found in some of them."""

    def offer(self, sequence: int, grey: Grey, hurry: bool) -> None: ...

    def take(self) -> Detection | None: ...

    def close(self) -> None: ...


class ImmediateDetections:
    """Searches every nth frame offered while the caller waits: for measuring, and where every run must give the same."""

    def __init__(self, detector: Detector, every: int = 1) -> None:
        self._detector, self._every, self._offered = detector, every, 0
        self._found: Detection | None = None

    def offer(self, sequence: int, grey: Grey, hurry: bool) -> None:
        self._offered += 1
        if hurry or (self._offered - 1) % self._every == 0:
            started_s = monotonic()
            self._found = Detection(sequence, self._detector.detect(grey), monotonic() - started_s)

    def take(self) -> Detection | None:
        found, self._found = self._found, None
        return found

    def close(self) -> None:
        """Nothing runs."""


class DetectionThread:
    """every_s: the pause between the beginnings of two searches while all is well; `hurry` (the track is lost) leaves it out."""

    def __init__(self, detector: Detector, every_s: float = 0.12) -> None:
        self._detector, self._every_s = detector, every_s
        self._frames: Newest[tuple[int, Grey]] = Newest()
        self._found: Newest[Detection] = Newest()
        self._next_s, self._stopping = 0.0, Event()
        self._thread = Thread(target=self._run, name="board detection", daemon=True)
        self._thread.start()

    def offer(self, sequence: int, grey: Grey, hurry: bool) -> None:
        if hurry or monotonic() >= self._next_s:
            self._next_s = monotonic() + self._every_s
            self._frames.put((sequence, grey))

    def take(self) -> Detection | None:
        return self._found.take(0.0)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join(_LEAVE_S)

    def _run(self) -> None:
        while not self._stopping.is_set():
            frame = self._frames.take(_POLL_S)
            if frame is None:
                continue
            started_s = monotonic()
            try:
                corners = self._detector.detect(frame[1])
            except Exception:
                # One odd picture must not end tracking for good.
                log.exception("searching a frame for the board failed")
                continue
            self._found.put(Detection(frame[0], corners, monotonic() - started_s))
