"""How large frames may be: larger ones are scaled down, with their aspect."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import UInt8

from viewfinder.flow.frames import Bgr


@dataclass(frozen=True)
class SizeLimit:
    """width_px, height_px: the most of each; None is no limit."""

    width_px: int | None = None
    height_px: int | None = None

    def fit(self, width_px: int, height_px: int) -> tuple[int, int]:
        """(width, height) with the same aspect, within the limits, never enlarged."""
        pairs = ((self.width_px, width_px), (self.height_px, height_px))
        scale = min([1.0, *(most / size for most, size in pairs if most is not None)])
        return max(1, round(width_px * scale)), max(1, round(height_px * scale))

    def applied(self, bgr: Bgr) -> UInt8[np.ndarray, "fitted_height fitted_width 3"]:
        """The picture itself where it is small enough, else scaled down by areas."""
        import cv2

        size_px = self.fit(bgr.shape[1], bgr.shape[0])
        return bgr if size_px == (bgr.shape[1], bgr.shape[0]) else cv2.resize(bgr, size_px, interpolation=cv2.INTER_AREA)
