"""PupilGrid: a picture of the pupil as a grid of cells, and the kernels that it casts."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf import kernel_radius_px
from mrbokeh.system.errors import InputError

EXTENT = 1.2
"""Reach of the picture in radii of the unit pupil: openings end at 1, unless the lens blurs more than was calibrated."""

_SHARP_PX = 1.0  # up to this diameter a kernel is the pixel itself, as mrbokeh.optics.psf.shown_diameter_px has it
_LEAST_SIDE, _MOST_SIDE = 21, 41
_LEAST_LIGHT = 1e-7  # of a kernel's taps: fewer are left out at its border
_DRAWN_PX = 64  # an aperture is drawn this many times finer than its cells are, all in all


@dataclass(frozen=True)
class PupilGrid:
    """Grid of `side` x `side` square cells over -EXTENT..EXTENT of the pupil, x right, y down.

    Cells within the circle of radius EXTENT are used. Pictures of a pupil are (cells, ...) arrays over `used`, light per cell: they sum to
    1.
    """

    side: int

    def __post_init__(self) -> None:
        if not (_LEAST_SIDE <= self.side <= _MOST_SIDE and self.side % 2):
            raise InputError(f"a picture of a pupil needs an odd side of {_LEAST_SIDE} to {_MOST_SIDE} cells, got {self.side}")

    @classmethod
    def for_diameter(cls, largest_px: float, cell_px: float, most: int) -> "PupilGrid":
        """Return a grid with cells about so large (in pixels) in the largest kernel, and at most `most` a side."""
        return cls(int(np.clip(np.ceil(EXTENT * largest_px / cell_px), _LEAST_SIDE, min(most, _MOST_SIDE) - 1)) // 2 * 2 + 1)

    @property
    def cell(self) -> float:
        """Return the width of a cell in pupil radii."""
        return 2.0 * EXTENT / self.side

    @cached_property
    def used(self) -> Bool[np.ndarray, "side side"]:
        return np.asarray(np.hypot(*np.meshgrid(self._middles, self._middles)) <= EXTENT)

    @cached_property
    def places(self) -> Float64[np.ndarray, "cells 2"]:
        """Return the middles of the used cells, x and y."""
        x, y = np.meshgrid(self._middles, self._middles)
        return np.stack([x[self.used], y[self.used]], axis=1)

    @property
    def _middles(self) -> Float64[np.ndarray, " side"]:
        return (np.arange(self.side) + 0.5) * self.cell - EXTENT

    def square(self, picture: Float[np.ndarray, "cells channels"]) -> Float64[np.ndarray, "side side channels"]:
        """Return the picture with zeros in unused cells."""
        whole = np.zeros((self.side, self.side, picture.shape[1]))
        whole[self.used] = picture
        return whole

    def of_aperture(self, aperture: Aperture) -> Float64[np.ndarray, "cells 1"]:
        """Return an aperture without modifiers as a picture: the share of its light that goes through each cell."""
        fine = max(1, _DRAWN_PX // self.side) * 2 + 1
        psf = aperture.rasterize(self.side * fine / EXTENT).kernel
        size, whole = psf.shape[0], np.zeros((self.side * fine, self.side * fine))
        border = (whole.shape[0] - size) // 2
        cut = max(0, -border)
        at = slice(max(0, border), max(0, border) + size - 2 * cut)
        whole[at, at] = psf[cut : size - cut, cut : size - cut]
        picture = whole.reshape(self.side, fine, self.side, fine).sum(axis=(1, 3))[self.used]
        return np.asarray((picture / picture.sum())[:, None])


def kernel_of(
    grid: PupilGrid, picture: Float[np.ndarray, "cells channels"], diameter_px: float
) -> Float32[np.ndarray, "size size channels"]:
    """Return the kernel at a signed diameter: exactly what each pixel sees of the picture; it sums to 1 and has no border of zeros."""
    channels = picture.shape[1]
    if abs(diameter_px) <= _SHARP_PX:
        return np.ones((1, 1, channels), np.float32)
    radius = kernel_radius_px(diameter_px, EXTENT)
    shares = _shares(grid, diameter_px, radius)
    kernel = np.einsum("yi,ijc,xj->yxc", shares, grid.square(picture), shares, optimize=True)
    kernel[kernel < _LEAST_LIGHT] = 0.0
    while radius > 0 and not (kernel[0].any() or kernel[-1].any() or kernel[:, 0].any() or kernel[:, -1].any()):
        kernel, radius = kernel[1:-1, 1:-1], radius - 1
    return np.ascontiguousarray(kernel / kernel.sum(axis=(0, 1))).astype(np.float32)


def _shares(grid: PupilGrid, diameter_px: float, radius: int) -> Float64[np.ndarray, "taps side"]:
    """Return the share of each column of cells in each column of pixels."""
    half = 0.5 * diameter_px
    borders = (np.arange(grid.side + 1) * grid.cell - EXTENT) * half
    low, high = np.minimum(borders[:-1], borders[1:]), np.maximum(borders[:-1], borders[1:])
    pixels = np.arange(-radius, radius + 1)[:, None]
    overlap = np.minimum(high, pixels + 0.5) - np.maximum(low, pixels - 0.5)
    return np.asarray(np.maximum(overlap, 0.0) / (high - low))
