"""A moving test pattern, to look at a stream without a camera."""

import itertools
import time
from collections.abc import Iterator
from threading import Event

import numpy as np

from viewfinder.flow.frames import Bgr, CameraFrame
from viewfinder.sources.rhythm import Rhythm

DEFAULT_FPS = 30.0


class PatternSource:
    """Colour bars that move to the left, with the number of the frame. A FrameSource."""

    name, transfer = "test pattern", "srgb"
    status: str | None = None

    def __init__(self, width_px: int, height_px: int, fps: float = DEFAULT_FPS) -> None:
        bars = np.array([[(i >> 2 & 1) * 200 + 20, (i >> 1 & 1) * 200 + 20, (i & 1) * 200 + 20] for i in range(8)], np.float64)
        columns = bars[np.arange(width_px) * 8 // width_px]
        fade = np.linspace(1.0, 0.3, height_px)[:, None, None]
        self._background = np.rint(columns[None] * fade).astype(np.uint8)
        self._fps = fps

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        rhythm = Rhythm(stopping)
        for sequence in itertools.count():
            bgr = self.picture(sequence)
            if not rhythm.wait_for(sequence / self._fps):
                return
            yield CameraFrame(bgr, time.monotonic(), sequence)

    def picture(self, sequence: int) -> Bgr:
        """The frame of that number (H, W, 3), blue first."""
        import cv2

        bgr = np.roll(self._background, -4 * sequence, axis=1)
        cv2.putText(bgr, str(sequence), (12, bgr.shape[0] - 14), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2, cv2.LINE_AA)
        return bgr
