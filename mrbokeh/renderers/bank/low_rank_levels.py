"""Levels: the diameters at which low-rank kernels are tabulated, and how the pixels of a picture share them."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int, Int16

from mrbokeh.renderers.kernels.low_rank_kernel import LowRankKernel

_BEGINS_PX = np.array([0.0, 4.0, 10.0, 20.0])
_LEVELS_PER_PX = np.array([8.0, 4.0, 2.0, 1.0])
"""Levels lie 1/8 px of diameter apart up to 4 px, 1/4 px up to 10 px, 1/2 px up to 20 px and 1 px from there."""
_ZEROS_BEFORE, _ZEROS_BEHIND = 3, 6  # around the taps of a column, see _low_rank_filter_numba._down


@dataclass(frozen=True)
class Levels:
    """Which kernels every pixel takes: 1 - upper of its level's and upper of the next one's.

    diameters_px: one per level in use, from the lowest; nan where no pixel needs it.
    level: (H, W) index into diameters_px, negative for pixels that take no part. upper: (H, W) in [0, 1).
    """

    diameters_px: tuple[float, ...]
    level: Int16[np.ndarray, "height width"]
    upper: Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class Taps:
    """Kernels of all levels in arrays of one size, in the order in which compiled code reads them; see scatter_piece."""

    columns: Float32[np.ndarray, "levels terms padded"]
    rows: Float32[np.ndarray, "levels terms size"]
    ranks: Int[np.ndarray, " levels"]
    radii_px: Int[np.ndarray, " levels"]


def levels_of(diameters_px: Float32[np.ndarray, "height width"], exact: Float32[np.ndarray, "height width"]) -> Levels:
    """Sort the pixels with a diameter above 0 that are not wholly spread exactly (`exact`, a share) into levels.

    The steps are fixed, so that a pixel's kernel depends on nothing but its own diameter; only where all of them have the
    same diameter it is taken as it is, as a level of its own.
    """
    from mrbokeh.renderers.bank._low_rank_pixels_numba import NOT_A_LEVEL, sort_into_levels

    level, upper = np.empty(diameters_px.shape, np.int16), np.empty(diameters_px.shape, np.float32)
    largest_px = float(diameters_px.max())
    if (diameters_px == np.float32(largest_px)).sum() == np.count_nonzero(diameters_px):
        level[:] = np.where((diameters_px > 0) & (exact < 1.0), 0, NOT_A_LEVEL)
        upper[:] = 0.0
        return Levels((largest_px,), level, upper)
    steps_px = _grid_px(largest_px)
    used = np.zeros(len(steps_px), bool)
    sort_into_levels(level, upper, used, diameters_px, exact, _BEGINS_PX, _LEVELS_PER_PX)
    lowest, end = int(np.argmax(used)), len(used) - int(np.argmax(used[::-1]))
    level -= np.where(level >= 0, np.int16(lowest), np.int16(0))
    return Levels(tuple(np.where(used, steps_px, np.nan)[lowest:end].tolist()), level, upper)


def _grid_px(largest_px: float) -> np.ndarray:
    """Diameters of the levels up to the first beyond the largest."""
    ends_px = [*_BEGINS_PX[1:], max(_BEGINS_PX[-1], np.ceil(largest_px)) + 2.0]
    return np.concatenate([np.arange(begin, end, 1.0 / per) for begin, end, per in zip(_BEGINS_PX, ends_px, _LEVELS_PER_PX, strict=True)])


def taps_of(levels: Levels, kernel_at: Callable[[float], LowRankKernel], mirrored: bool) -> Taps:
    """The kernels of all levels as taps; mirrored: for pixels in front of the focus."""
    kernels = [None if np.isnan(diameter_px) else kernel_at(diameter_px) for diameter_px in levels.diameters_px]
    known = [kernel for kernel in kernels if kernel is not None]
    terms, size = max(kernel.rank for kernel in known), 2 * max(kernel.radius_px for kernel in known) + 1
    columns = np.zeros((len(kernels), terms, _ZEROS_BEFORE + size + _ZEROS_BEHIND), np.float32)
    rows = np.zeros((len(kernels), terms, size), np.float32)
    order = slice(None) if mirrored else slice(None, None, -1)  # seen from the result, a kernel is met from its far end
    for i, kernel in enumerate(kernels):
        if kernel is not None:
            count = 2 * kernel.radius_px + 1
            columns[i, : kernel.rank, _ZEROS_BEFORE : _ZEROS_BEFORE + count] = kernel.scaled_columns[:, order]
            rows[i, : kernel.rank, :count] = kernel.scaled_rows[:, order]
    return Taps(columns, rows, _each(kernels, lambda kernel: kernel.rank), _each(kernels, lambda kernel: kernel.radius_px))


def _each(kernels: Sequence[LowRankKernel | None], of: Callable[[LowRankKernel], int]) -> Int[np.ndarray, " levels"]:
    return np.array([0 if kernel is None else of(kernel) for kernel in kernels], np.int64)
