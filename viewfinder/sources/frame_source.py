"""Where camera frames come from: a video file played in a loop, a webcam, a moving test pattern."""

import itertools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from threading import Event
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from mrbokeh.errors import InputError
from mrbokeh.video_io import probe, read_display_frames
from viewfinder.frames import CameraFrame

# A camera may differ this much from the layer's aspect ratio before the picture would look stretched.
_ASPECT_TOLERANCE = 0.01
DEFAULT_FPS = 30.0


@runtime_checkable
class FrameSource(Protocol):
    """A camera. `transfer` names the curve of its codes (see mrbokeh.video_color); `name` is for people to read."""

    name: str
    transfer: str

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        """Frames in the rhythm in which the camera gives them, until `stopping` is set; InputError if the camera fails."""
        ...


def open_source(text: str, width_px: int, height_px: int, fps: float | None) -> FrameSource:
    """The source that a user named: `test`, the number of a camera, or the path of a video; frames come in the size asked for."""
    if fps is not None and fps <= 0:
        raise InputError(f"--fps: expected a positive number of frames per second, got {fps}")
    if text == "test":
        return PatternSource(width_px, height_px, fps or DEFAULT_FPS)
    if text.isdigit():
        return WebcamSource(int(text), width_px, height_px, fps)
    if not Path(text).is_file():
        raise InputError(f"--source: expected a video file, the number of a camera or the word test, got {text!r}, which is none of them")
    return VideoFileSource(Path(text), width_px, height_px, fps)


class VideoFileSource:
    """A video as a virtual camera: played in its own rhythm, from the start again when it ends."""

    def __init__(self, path: Path, width_px: int, height_px: int, fps: float | None = None) -> None:
        info = probe(path)
        _require_aspect(str(path), info.width_px, info.height_px, width_px, height_px)
        self.name, self.transfer = path.name, info.color.transfer_name
        self._path, self._size_px, self._fps, self._last_s = path, (width_px, height_px), fps, float(1 / info.frame_rate)

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        rhythm, sequence = _Rhythm(stopping), itertools.count()
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


class WebcamSource:
    """A UVC webcam (or any camera that OpenCV opens by number)."""

    transfer = "srgb"

    def __init__(self, index: int, width_px: int, height_px: int, fps: float | None = None) -> None:
        import cv2

        self._camera = cv2.VideoCapture(index)
        if not self._camera.isOpened():
            raise InputError(f"camera {index} cannot be opened: it is not plugged in, in use, or not allowed for this program")
        self._camera.set(cv2.CAP_PROP_FRAME_WIDTH, width_px)
        self._camera.set(cv2.CAP_PROP_FRAME_HEIGHT, height_px)
        self._camera.set(cv2.CAP_PROP_BUFFERSIZE, 1)
        if fps:
            self._camera.set(cv2.CAP_PROP_FPS, fps)
        self.name, self._size_px = f"camera {index}", (width_px, height_px)
        given = [int(self._camera.get(key)) for key in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT)]
        _require_aspect(self.name, given[0], given[1], width_px, height_px)

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        import cv2

        try:
            for sequence in itertools.count():
                there, bgr = self._camera.read()
                captured_s = time.monotonic()
                if stopping.is_set():
                    return
                if not there:
                    raise InputError(f"{self.name} stopped giving pictures: plug it in again and restart the viewfinder")
                if bgr.shape[1::-1] != self._size_px:
                    bgr = cv2.resize(bgr, self._size_px, interpolation=cv2.INTER_AREA)
                yield CameraFrame(bgr, captured_s, sequence)
        finally:
            self._camera.release()


class PatternSource:
    """Colour bars that move to the left, with the number of the frame, to look at a stream without a camera."""

    name, transfer = "test pattern", "srgb"

    def __init__(self, width_px: int, height_px: int, fps: float = DEFAULT_FPS) -> None:
        bars = np.array([[(i >> 2 & 1) * 200 + 20, (i >> 1 & 1) * 200 + 20, (i & 1) * 200 + 20] for i in range(8)], np.float64)
        columns = bars[np.arange(width_px) * 8 // width_px]
        fade = np.linspace(1.0, 0.3, height_px)[:, None, None]
        self._background = np.rint(columns[None] * fade).astype(np.uint8)
        self._fps = fps

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        rhythm = _Rhythm(stopping)
        for sequence in itertools.count():
            bgr = self.picture(sequence)
            if not rhythm.wait_for(sequence / self._fps):
                return
            yield CameraFrame(bgr, time.monotonic(), sequence)

    def picture(self, sequence: int) -> UInt8[np.ndarray, "height width 3"]:
        """The frame of that number (H, W, 3), blue first."""
        import cv2

        bgr = np.roll(self._background, -4 * sequence, axis=1)
        cv2.putText(bgr, str(sequence), (12, bgr.shape[0] - 14), cv2.FONT_HERSHEY_SIMPLEX, 0.8, (255, 255, 255), 2, cv2.LINE_AA)
        return bgr


class _Rhythm:
    """Waits for the times of a recording as they pass in reality; what is late is not hurried after."""

    def __init__(self, stopping: Event, now_s: Callable[[], float] = time.monotonic) -> None:
        self._stopping, self._now_s = stopping, now_s
        self._start_s: float | None = None
        self._due_s = now_s()

    def restart(self, pause_s: float) -> None:
        """The recording begins again, `pause_s` after the last time waited for."""
        self._start_s = None
        self._due_s += pause_s

    def wait_for(self, time_s: float) -> bool:
        """False if the stop came first."""
        if self._start_s is None:
            self._start_s = self._due_s - time_s
        self._due_s = self._start_s + time_s
        ahead_s = self._due_s - self._now_s()
        if ahead_s < 0:
            self._start_s -= ahead_s
            self._due_s -= ahead_s
        return not self._stopping.wait(max(ahead_s, 0.0))


def _require_aspect(name: str, width_px: int, height_px: int, wanted_width_px: int, wanted_height_px: int) -> None:
    ratio = (width_px * wanted_height_px) / (height_px * wanted_width_px)
    if abs(ratio - 1) > _ASPECT_TOLERANCE:
        raise InputError(
            f"{name} gives {width_px}x{height_px} px, but the layer is {wanted_width_px}x{wanted_height_px} px: "
            f"render the layer with the aspect ratio of the camera (frames are scaled to the size of the layer)"
        )
