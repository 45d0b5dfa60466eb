"""A video file as a virtual camera."""

import itertools
import time
from collections.abc import Iterator
from pathlib import Path
from threading import Event

from mrbokeh.video.clip import probe, read_display_frames
from viewfinder.flow.frames import CameraFrame
from viewfinder.sources.rhythm import Rhythm
from viewfinder.sources.size_limit import SizeLimit


class VideoFileSource:
    """Played in its own rhythm, from the start again when it ends. A FrameSource.

    max_width_px, max_height_px: larger pictures are scaled down with their aspect. fps: at most so many frames per second.
    """

    status: str | None = None

    def __init__(self, path: Path, max_width_px: int | None = None, max_height_px: int | None = None, fps: float | None = None) -> None:
        info = probe(path)
        self.name, self.transfer = path.name, info.color.transfer_name
        self._path, self._fps, self._last_s = path, fps, float(1 / info.frame_rate)
        self._size_px = SizeLimit(max_width_px, max_height_px).fit(info.width_px, info.height_px)

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
