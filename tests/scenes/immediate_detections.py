"""Board detection without a thread: for measuring, and for tests in which every run must give the same."""

from time import monotonic

from mrbokeh.tracking.charuco.detector import Grey
from viewfinder.tracking.charuco_tracker import Detection, Detector


class ImmediateDetections:
    """Detections that search every nth frame offered while the caller waits, so that every run gives the same."""

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
