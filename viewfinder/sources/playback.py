"""Sources without a camera: a moving test pattern and a video file, in their own rhythm.

A moving test pattern, to look at a stream without a camera.

A video file as a virtual camera.
"""

import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event

import numpy as np

from mrbokeh.video.clip import probe, read_display_frames
from viewfinder.frames import Bgr, CameraFrame
from viewfinder.sources.frame_source import UNLIMITED, SizeLimit


class Rhythm:
    """Rhythm of a recording as its times pass in reality; what is late is not hurried after."""

    def __init__(self, stopping: Event, now_s: Callable[[], float] = time.monotonic) -> None:
        self._stopping, self._now_s = stopping, now_s
        self._start_s: float | None = None
        self._due_s = now_s()

    def restart(self, pause_s: float) -> None:
        """Begin the recording again, `pause_s` after the last time waited for."""
        self._start_s = None
        self._due_s += pause_s

    def wait_for(self, time_s: float) -> bool:
        """Wait for a time; False if the stop came first."""
        if self._start_s is None:
            self._start_s = self._due_s - time_s
        self._due_s = self._start_s + time_s
        ahead_s = self._due_s - self._now_s()
        if ahead_s < 0:
            self._start_s -= ahead_s
            self._due_s -= ahead_s
        return not self._stopping.wait(max(ahead_s, 0.0))


DEFAULT_FPS = 30.0


class PatternSource:
    """FrameSource of colour bars that move to the left, with the number of the frame."""

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
        """Return the frame of that number (H, W, 3), blue first."""
        import cv2

        bgr = np.roll(self._background, -4 * sequence, axis=1)
        cv2.putText(bgr, str(sequence), (12, bgr.shape[0] - 14), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2, cv2.LINE_AA)
        return bgr


class VideoFileSource:
    """FrameSource of a video file, played in its own rhythm, from the start again when it ends.

    limit: larger pictures are scaled down with their aspect. fps: at most so many frames per second.
    """

    status: str | None = None

    def __init__(self, path: Path, limit: SizeLimit = UNLIMITED, fps: float | None = None) -> None:
        info = probe(path)
        self.name, self.transfer = path.name, info.color.transfer_name
        self._path, self._fps, self._last_s = path, fps, float(1 / info.frame_rate)
        self._size_px = limit.fit(info.width_px, info.height_px)

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        rhythm, sequence = Rhythm(stopping), itertools.count()
        while not stopping.is_set():
            next_s = -1.0
            for frame in read_display_frames(self._path, *self._size_px):
                if frame.time_s < next_s:
                    continue
                if not rhythm.wait_for(frame.time_s):
                    return
                next_s = frame.time_s + (1 / self._fps - 1e-6 if self._fps else 0.0)
                yield CameraFrame(frame.bgr, time.monotonic(), next(sequence))
            rhythm.restart(self._last_s)
