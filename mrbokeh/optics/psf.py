"""Psf: how one point of light spreads over the pixels around it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class Psf:
    """Kernel centred on its source pixel.

    kernel: (K, K), K odd, sums to 1; rows go down, columns go right.
    """

    kernel: Float64[np.ndarray, "size size"]

    def __post_init__(self) -> None:
        if self.kernel.ndim != 2 or self.kernel.shape[0] != self.kernel.shape[1] or self.kernel.shape[0] % 2 == 0:
            raise InputError(f"a PSF kernel must be square with an odd size, but came with shape {self.kernel.shape}")

    @property
    def radius_px(self) -> int:
        """Return the whole pixels from the centre to the border of the kernel."""
        return self.kernel.shape[0] // 2


def identity_psf() -> Psf:
    """Return the PSF of what is in focus: the pixel itself."""
    return Psf(np.ones((1, 1)))


def shown_diameter_px(diameter_px: Float[np.ndarray, "*batch"] | float, unit_radius: float) -> Float[np.ndarray, "*batch"]:
    """Return the signed diameter at which an opening is drawn, so that its kernel is the identity up to one pixel and never jumps.

    An opening that stays within the unit circle fits into one pixel up to a diameter of 1, so it is drawn as it is. One that
    reaches `unit_radius` = 1 + e would leave the pixel before: it is drawn at 0 (the identity) up to 1 px, at 1 / (1 + e) just
    above, where it fills the pixel, and from there linearly up to 1 + 4 e px, beyond which it has its true size.
    """
    diameter = np.asarray(diameter_px, np.float64)
    size, excess = np.abs(diameter), max(unit_radius - 1.0, 0.0)
    if excess > 0.0:
        full = 1.0 + 4.0 * excess
        grown = 1.0 / unit_radius + (size - 1.0) * (full - 1.0 / unit_radius) / (full - 1.0)
        size = np.where(size < full, grown, size)
    return np.where(np.abs(diameter) <= 1.0, 0.0, np.copysign(size, diameter))


def kernel_radius_px(diameter_px: float, unit_radius: float = 1.0) -> int:
    """Return the smallest radius of an odd kernel that holds an outline reaching `unit_radius` at this (signed) diameter."""
    return max(0, int(np.ceil(abs(diameter_px) * 0.5 * unit_radius - 0.5)))
