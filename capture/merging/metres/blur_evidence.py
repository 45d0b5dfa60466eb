"""Blur evidence: how well every slice fits the all-in-focus picture blurred by discs of growing diameter.

Pictures are compared without their coarse light, which leaks in from afar and differs with exposure, in units of the square root of
light, in which photons are evenly noisy. Sums over windows are kept on a grid of cells.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

LARGEST_WORKING_PX = 0.6e6
"""Larger pictures are compared at this size."""
DIAMETERS_PX = (0.0, 1.25, 1.75, 2.25, 3.0, 4.0, 5.25, 7.0, 9.25, 12.0, 16.0, 21.0)
DRAWN_PX = (0.0, 1.2407, 1.5986, 1.9489, 2.7846, 3.8978, 5.1770, 6.9342, 9.2071, 11.9664, 15.9751, 20.9811)
"""Discs to draw for these diameters: `mrbokeh.optics.drawn_diameters`, whose table takes longer to make than all evidence of a stack."""
_SUBPIXELS = 32
_WIDE_SHRINK = 3.0
_CELL_PX = 4
_WINDOW_CELLS = 1.25
_COARSE_PX = 10.0
_DARK = 0.02
_LEAST_KNOWN = 0.3
_MEAN_OF_CHANNELS = np.full((1, 3), 1.0 / 3.0, np.float32)

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Small = Float32[np.ndarray, "rows columns"]


@dataclass(frozen=True)
class BlurEvidence:
    """Misfits of slices to the blurred picture, on a grid of cells.

    errors (cells, slices, rungs): mean squared difference between a slice and the blurred picture; -1 where the slice has no data.
    gaps (cells, rungs - 1): the same between neighbouring rungs. diameters_px: of the rungs, in pixels of the stack.
    shape: (rows, columns) of the grid of cells. full: (H, W) of the stack, which was compared `shrink` times smaller.
    """

    errors: Float32[np.ndarray, "cells slices rungs"]
    gaps: Float32[np.ndarray, "cells steps"]
    diameters_px: Float[np.ndarray, " rungs"]
    shape: tuple[int, int]
    full: tuple[int, int]
    shrink: float

    def at_cells(self, plane: np.ndarray) -> np.ndarray:
        """Return (cells,) a picture's value in the middle of each cell."""
        rows, columns = (
            np.minimum((np.arange(n) + 0.5) * full / n, full - 1).astype(int) for n, full in zip(self.shape, self.full, strict=True)
        )
        return plane[np.ix_(rows, columns)].ravel()

    @property
    def texture(self) -> Float32[np.ndarray, " cells"]:
        """Return the detail that the widest blur takes away: an upper bound of what can be told from a cell."""
        return self.gaps.sum(axis=1)


def blur_evidence(
    slices: Callable[[], Iterable[Rgb]],
    all_in_focus: Rgb,
    count: int,
    valid: Callable[[int], Mask] | None = None,
    excluded: Mask | None = None,
) -> tuple[BlurEvidence, BlurEvidence]:
    """Compare every slice, read once, with every rung; return (fine, wide), the latter on a smaller picture, for larger blur.

    excluded: (H, W) what is saturated in some slice.
    """
    full = (all_in_focus.shape[0], all_in_focus.shape[1])
    shrink = max(1.0, float(np.sqrt(full[0] * full[1] / LARGEST_WORKING_PX)))
    fine, wide = (_Comparison.of(all_in_focus, count, excluded, shrink * each) for each in (1.0, _WIDE_SHRINK))
    for index, rgb in enumerate(slices()):
        known = None if valid is None or (here := valid(index)).all() else here
        grey = cv2.transform(np.ascontiguousarray(rgb), _MEAN_OF_CHANNELS)
        fine.add(index, grey, known)
        wide.add(index, grey, known)
    return fine.evidence(full), wide.evidence(full)


@dataclass(frozen=True)
class _Comparison:
    """Slices compared at one size.

    ladder: the all-in-focus picture blurred to every rung, without its coarse light; usable: share of a pixel that is not excluded.
    """

    ladder: tuple[Small, ...]
    light: Float32[np.ndarray, "cell_rows cell_columns"]
    usable: Small
    errors: Float32[np.ndarray, "cells slices rungs"]
    shrink: float
    excludes: bool

    @classmethod
    def of(cls, all_in_focus: Rgb, count: int, excluded: Mask | None, shrink: float) -> "_Comparison":
        size = (_whole_cells(all_in_focus.shape[1] / shrink), _whole_cells(all_in_focus.shape[0] / shrink))
        grey = _resized(cv2.transform(np.ascontiguousarray(all_in_focus), _MEAN_OF_CHANNELS), size)
        ladder = tuple(each - _coarse(each) for each in (grey if drawn == 0 else _blurred(grey, drawn) for drawn in DRAWN_PX))
        grid = (size[0] // _CELL_PX, size[1] // _CELL_PX)
        usable = np.ones_like(grey) if excluded is None else _resized((~excluded).astype(np.float32), size)
        errors = np.empty((grid[0] * grid[1], count, len(ladder)), np.float32)
        light = _summed(grey, grid) + np.float32(_DARK)
        return cls(ladder=ladder, light=light, usable=usable, errors=errors, shrink=shrink, excludes=excluded is not None)

    @property
    def grid(self) -> tuple[int, int]:
        return self.light.shape[1], self.light.shape[0]

    def add(self, index: int, grey: Plane, known: Mask | None) -> None:
        """Compare a slice; known: where it has data, None for everywhere."""
        size = (self.usable.shape[1], self.usable.shape[0])
        plane = _resized(grey, size)
        plane = cv2.subtract(plane, _coarse(plane))
        weight = self.usable if known is None else self.usable * _resized(known.astype(np.float32), size)
        share = _summed(weight, self.grid)
        for rung, blurred in enumerate(self.ladder):
            self.errors[:, index, rung] = self._mean_square(cv2.subtract(plane, blurred), weight, share).ravel()
        self.errors[(share < _LEAST_KNOWN).ravel(), index] = -1.0

    def evidence(self, full: tuple[int, int]) -> BlurEvidence:
        share = _summed(self.usable, self.grid)
        gaps = [self._mean_square(cv2.subtract(a, b), self.usable, share).ravel() for a, b in pairwise(self.ladder)]
        diameters_px = np.array(DIAMETERS_PX) * self.shrink
        return BlurEvidence(
            errors=self.errors,
            gaps=np.stack(gaps, axis=1),
            diameters_px=diameters_px,
            shape=(self.light.shape[0], self.light.shape[1]),
            full=full,
            shrink=self.shrink,
        )

    def _mean_square(self, difference: Small, weight: Small, share: np.ndarray) -> np.ndarray:
        cv2.multiply(difference, difference, dst=difference)
        if weight is not self.usable or self.excludes:
            cv2.multiply(difference, weight, dst=difference)
        return _summed(difference, self.grid) / (self.light * np.maximum(share, _LEAST_KNOWN))


def _whole_cells(length_px: float) -> int:
    return max(2, int(length_px) // _CELL_PX) * _CELL_PX


def _resized(plane: Plane, size: tuple[int, int]) -> Small:
    """Average over areas; a few pixels too many are cut off, for resampling would blur."""
    if max(plane.shape[1] - size[0], plane.shape[0] - size[1]) < _CELL_PX:
        return np.ascontiguousarray(plane[: size[1], : size[0]])
    return cv2.resize(plane, size, interpolation=cv2.INTER_AREA)


def _blurred(grey: Plane, diameter_px: float) -> Plane:
    return cv2.filter2D(grey, -1, disc_kernel(diameter_px), borderType=cv2.BORDER_REPLICATE)


def disc_kernel(diameter_px: float) -> Float32[np.ndarray, "size size"]:
    """Return the share of a disc in each pixel, of sum 1, by subpixels."""
    reach = int(np.ceil(0.5 * diameter_px - 0.5))
    along = (np.arange((2 * reach + 1) * _SUBPIXELS) + 0.5) / _SUBPIXELS - reach - 0.5
    inside = along[:, None] ** 2 + along**2 <= 0.25 * diameter_px**2
    kernel = inside.reshape(2 * reach + 1, _SUBPIXELS, 2 * reach + 1, _SUBPIXELS).sum(axis=(1, 3)).astype(np.float32)
    return kernel / kernel.sum()


def _coarse(plane: Plane) -> Plane:
    size = (max(1, plane.shape[1] // 4), max(1, plane.shape[0] // 4))
    small = cv2.GaussianBlur(cv2.resize(plane, size, interpolation=cv2.INTER_AREA), (0, 0), _COARSE_PX / 4)
    return cv2.resize(small, (plane.shape[1], plane.shape[0]), interpolation=cv2.INTER_LINEAR)


def _summed(plane: Plane, grid: tuple[int, int]) -> Small:
    """Return means over windows about every cell."""
    return cv2.GaussianBlur(cv2.resize(plane, grid, interpolation=cv2.INTER_AREA), (0, 0), _WINDOW_CELLS)
