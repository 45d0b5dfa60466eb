"""ExactSize: a source whose frames are scaled to one size, for what was made for pictures of that size."""

from collections.abc import Iterator
from dataclasses import replace
from threading import Event

import numpy as np
from jaxtyping import UInt8

from mrbokeh.system.errors import InputError
from viewfinder.flow.frames import Bgr, CameraFrame
from viewfinder.sources.base import FrameSource

# A camera may differ this much from the aspect ratio before the picture would look stretched.
_ASPECT_TOLERANCE = 0.01


class ExactSize:
    """A FrameSource over another. Its frames raise InputError where the camera's aspect ratio is another one."""

    def __init__(self, source: FrameSource, width_px: int, height_px: int) -> None:
        self._source, self._size_px = source, (width_px, height_px)
        self.name = source.name

    @property
    def transfer(self) -> str:
        return self._source.transfer

    @property
    def status(self) -> str | None:
        return self._source.status

    def frames(self, stopping: Event) -> Iterator[CameraFrame]:
        for frame in self._source.frames(stopping):
            yield replace(frame, bgr=self._scaled(frame.bgr), full_picture=None)

    def _scaled(self, bgr: Bgr) -> UInt8[np.ndarray, "scaled_height scaled_width 3"]:
        import cv2

        (width, height), (given_height, given_width) = self._size_px, bgr.shape[:2]
        if (given_width, given_height) == self._size_px:
            return bgr
        if abs(given_width * height / (given_height * width) - 1.0) > _ASPECT_TOLERANCE:
            raise InputError(
                f"{self.name} gives {given_width}x{given_height} px, but the layer is {width}x{height} px: "
                f"render the layer with the aspect ratio of the camera (frames are scaled to the size of the layer)"
            )
        return cv2.resize(bgr, self._size_px, interpolation=cv2.INTER_AREA)
