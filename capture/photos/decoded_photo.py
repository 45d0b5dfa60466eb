"""DecodedPhoto: one photograph in linear light."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from capture.photos.libraw import WhiteBalance
from mrbokeh.images.camera_rgb import Matrix3x3


@dataclass(frozen=True)
class Photosites:
    """The sensor's own grid before any reduction, and how many of its photosites gave no more than "full"."""

    width: int
    height: int
    full: int = 0

    @property
    def full_fraction(self) -> float:
        return self.full / (self.width * self.height)


@dataclass(frozen=True)
class DecodedPhoto:
    """One photograph in linear light.

    rgb: (H, W, 3) white-balanced camera RGB; Rec.709 where rec709_from_camera is None (JPEG, EXR).
    saturated: (H, W) how much of each pixel comes from full photosites or their neighbours in demosaicing, 0 to 1.
    white_balance: multipliers of red, green, blue, green being 1; None where it was applied before (JPEG, EXR).
    saturation_level: the linear value of a saturated green or grey; None where there is no such thing (EXR).
    remarks: what a reader of the result should know.
    half_suffices: the file holds 8 bits a channel. Their steps are 0.9 % near white and more below, those of half 0.1 % at most; 14-bit RAW
    and 16-bit files have finer ones near white (0.006 %) than half (0.05 %).
    """

    rgb: Float32[np.ndarray, "height width 3"]
    rec709_from_camera: Matrix3x3 | None
    saturated: Float32[np.ndarray, "height width"]
    photosites: Photosites
    white_balance: WhiteBalance | None = None
    saturation_level: float | None = 1.0
    remarks: tuple[str, ...] = ()
    half_suffices: bool = False
