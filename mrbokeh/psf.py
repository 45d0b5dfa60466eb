"""Psf: how one point of light spreads over the pixels around it."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from mrbokeh.errors import InputError


@dataclass(frozen=True)
class Psf:
    """A kernel centred on its source pixel.

    kernel: (K, K), K odd, sums to 1; rows go down, columns go right.
    """

    kernel: Float64[np.ndarray, "size size"]

    def __post_init__(self) -> None:
        if self.kernel.ndim != 2 or self.kernel.shape[0] != self.kernel.shape[1] or self.kernel.shape[0] % 2 == 0:
            raise InputError(f"a PSF kernel must be square with an odd size, but came with shape {self.kernel.shape}")

    @property
    def radius_px(self) -> int:
        """Whole pixels from the centre to the border of the kernel."""
        return self.kernel.shape[0] // 2


def kernel_radius_px(diameter_px: float, unit_radius: float = 1.0) -> int:
    """The smallest radius of an odd kernel that holds an outline reaching `unit_radius` at this (signed) diameter."""
    return max(0, int(np.ceil(abs(diameter_px) * 0.5 * unit_radius - 0.5)))
