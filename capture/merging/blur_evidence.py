"""How well every slice fits the all-in-focus picture blurred by discs of growing diameter: what all blur is told from.

Pictures are compared without their coarse light, which leaks in from afar and differs with exposure, in units of the square root of
light, in which photons are evenly noisy. Sums over windows are kept on a grid of cells.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from mrbokeh.aperture import Aperture
from mrbokeh.drawn_diameters import drawn_diameters_px

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Small = Float32[np.ndarray, "rows columns"]

LARGEST_WORKING_PX = 1.2e6
"""Larger pictures are compared at this size."""
_DIAMETERS_PX = (0.0, 1.25, 1.75, 2.25, 3.0, 4.0, 5.25, 7.0, 9.25, 12.0, 16.0, 21.0)
_CELL_PX = 4
_WINDOW_CELLS = 1.25
_COARSE_PX = 10.0
_DARK = 0.02
_LEAST_KNOWN = 0.3


@dataclass(frozen=True)
class BlurEvidence:
    """errors (cells, slices, rungs): mean squared difference between a slice and the blurred picture; -1 where the slice has no data.

    gaps (cells, rungs - 1): the same between neighbouring rungs. diameters_px: of the rungs, in pixels of the stack.
    shape: (rows, columns) of the grid of cells. full: (H, W) of the stack. noise: what the difference is where both are alike.
    """

    errors: Float32[np.ndarray, "cells slices rungs"]
    gaps: Float32[np.ndarray, "cells steps"]
    diameters_px: Float[np.ndarray, " rungs"]
    shape: tuple[int, int]
    full: tuple[int, int]

    def at_cells(self, plane: np.ndarray) -> np.ndarray:
        """(cells,) a picture's value in the middle of each cell."""
        rows, columns = (
            np.minimum((np.arange(n) + 0.5) * full / n, full - 1).astype(int) for n, full in zip(self.shape, self.full, strict=True)
        )
        return plane[np.ix_(rows, columns)].ravel()

    @property
    def texture(self) -> Float32[np.ndarray, " cells"]:
        """What the widest blur takes away: upper bound of what can be told from a cell."""
        return self.gaps.sum(axis=1)


def blur_evidence(
    slices: Callable[[], Iterable[Rgb]],
    all_in_focus: Rgb,
    count: int,
    valid: Callable[[int], Mask] | None = None,
    excluded: Mask | None = None,
) -> BlurEvidence:
    """Compare every slice, read once, with every rung; excluded: (H, W) what is saturated in some slice."""
    full = (all_in_focus.shape[0], all_in_focus.shape[1])
    shrink = max(1.0, np.sqrt(full[0] * full[1] / LARGEST_WORKING_PX))
    size = (round(full[1] / shrink), round(full[0] / shrink))
    grey = _grey(all_in_focus, size)
    ladder = [grey if each == 0 else _blurred(grey, each) for each in _DIAMETERS_PX]
    grid = (-(-size[0] // _CELL_PX), -(-size[1] // _CELL_PX))
    usable = np.ones(size[::-1], np.float32) if excluded is None else _share(~excluded, size)
    light = _summed(grey, grid) + np.float32(_DARK)
    fine = [each - _coarse(each) for each in ladder]
    gaps = [_summed((b - a) ** 2 * usable, grid) / light for a, b in pairwise(fine)]
    errors = np.empty((grid[0] * grid[1], count, len(fine)), np.float32)
    base = _summed(usable, grid)
    gaps = [each / np.maximum(base, _LEAST_KNOWN) for each in gaps]
    for index, rgb in enumerate(slices()):
        plane = _grey(rgb, size)
        plane -= _coarse(plane)
        known = usable if valid is None or (here := valid(index)).all() else usable * _share(here, size)
        share = base if known is usable else _summed(known, grid)
        for rung, blurred in enumerate(fine):
            difference = cv2.subtract(plane, blurred)
            cv2.multiply(difference, difference, dst=difference)
            if known is not usable or excluded is not None:
                cv2.multiply(difference, known, dst=difference)
            errors[:, index, rung] = (_summed(difference, grid) / (light * np.maximum(share, _LEAST_KNOWN))).ravel()
        errors[(share < _LEAST_KNOWN).ravel(), index] = -1.0
    return BlurEvidence(
        errors, np.stack([each.ravel() for each in gaps], axis=1), np.array(_DIAMETERS_PX) * shrink, (grid[1], grid[0]), full
    )


def _grey(rgb: Rgb, size: tuple[int, int]) -> Small:
    grey = cv2.transform(np.ascontiguousarray(rgb), np.full((1, 3), 1.0 / 3.0, np.float32))
    return grey if size == (rgb.shape[1], rgb.shape[0]) else cv2.resize(grey, size, interpolation=cv2.INTER_AREA)


def _share(mask: Mask, size: tuple[int, int]) -> Small:
    return cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA)


def _blurred(grey: Plane, diameter_px: float) -> Plane:
    return cv2.filter2D(grey, -1, _kernel(diameter_px), borderType=cv2.BORDER_REPLICATE)


@cache
def _kernel(diameter_px: float) -> Float32[np.ndarray, "size size"]:
    disc = Aperture.disc()
    drawn = float(drawn_diameters_px(np.full((1, 1), diameter_px, np.float32), disc)[0, 0])
    return disc.rasterize(drawn).kernel.astype(np.float32)


def _coarse(plane: Plane) -> Plane:
    size = (max(1, plane.shape[1] // 4), max(1, plane.shape[0] // 4))
    small = cv2.GaussianBlur(cv2.resize(plane, size, interpolation=cv2.INTER_AREA), (0, 0), _COARSE_PX / 4)
    return cv2.resize(small, (plane.shape[1], plane.shape[0]), interpolation=cv2.INTER_LINEAR)


def _summed(plane: Plane, grid: tuple[int, int]) -> Small:
    """Means over windows about every cell."""
    return cv2.GaussianBlur(cv2.resize(plane, grid, interpolation=cv2.INTER_AREA), (0, 0), _WINDOW_CELLS)
