"""UVC webcam through OpenCV."""

import itertools
import sys
import time
from collections.abc import Callable, Generator, Iterator
from pathlib import Path
from threading import Event
from typing import Any

from mrbokeh.system.errors import InputError
from viewfinder.frames import CameraFrame
from viewfinder.sources.frame_source import UNLIMITED, CameraAwayError, SizeLimit, reconnecting


class WebcamSource:
    """FrameSource of a webcam (any camera that OpenCV opens by number); one that is pulled out is waited for.

    limit: asked of the camera; what it gives in place of that is scaled down with its aspect.
    open_camera: gives an open cv2.VideoCapture. Raises InputError where there is no such camera at the start.
    """

    transfer = "srgb"

    def __init__(
        self,
        index: int,
        limit: SizeLimit = UNLIMITED,
        fps: float | None = None,
        *,
        open_camera: Callable[[int], Any] | None = None,
    ) -> None:
        self.name = f"camera {index}"
        self.status: str | None = None
        self._index, self._fps, self._limit = index, fps, limit
        self._open_camera = open_camera or _open_by_number
        self._opened: Any = self._open()
        if self._opened is None:
            raise InputError(f"camera {index} cannot be opened: it is not plugged in, in use, or not allowed for this program")

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        sequence = itertools.count()
        return reconnecting(lambda: self._session(sequence, stopping), stopping, self._tell)

    def _tell(self, sentence: str | None) -> None:
        self.status = sentence

    def _session(self, sequence: Iterator[int], stopping: Event) -> Generator[CameraFrame, None, None]:
        camera, self._opened = self._opened or self._open(), None
        if camera is None:
            raise CameraAwayError(f"{self.name} is unplugged or in use: waiting for it")
        try:
            while not stopping.is_set():
                there, bgr = camera.read()
                captured_s = time.monotonic()
                if not there:
                    raise CameraAwayError(f"{self.name} stopped giving pictures: plug it in again")
                yield CameraFrame(self._limit.applied(bgr), captured_s, next(sequence), full_picture=bgr.copy)
        finally:
            camera.release()

    def _open(self) -> Any:
        """Return an open camera, set to what is wanted; None where it is not there."""
        import cv2

        camera = self._open_camera(self._index)
        if camera is None or not camera.isOpened():
            return None
        wanted = {
            cv2.CAP_PROP_FRAME_WIDTH: self._limit.width_px,
            cv2.CAP_PROP_FRAME_HEIGHT: self._limit.height_px,
            cv2.CAP_PROP_FPS: self._fps,
        }
        for key, value in {**wanted, cv2.CAP_PROP_BUFFERSIZE: 1}.items():
            if value is not None:
                camera.set(key, value)
        return camera


def _open_by_number(index: int) -> Any:
    import cv2

    # Asking OpenCV for what is not there prints warnings, each time anew.
    if sys.platform.startswith("linux") and not Path(f"/dev/video{index}").exists():
        return None
    return cv2.VideoCapture(index)
