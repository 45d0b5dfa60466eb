"""Tables of the kernels that polygon_differences splats whole: small ones by levels of diameter, as groups of neighbouring taps."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.kernels._vectors_numba import BLENDED_CELLS
from mrbokeh.renderers.polygon._ring_numba import Exact

LEVELS_PER_PX = 8.0
"""Small kernels are tabulated this densely in diameter; between two they are blended, which is 1e-3 of their peak off."""
_NOTHING = 1e-9
"""Below this a tap of a kernel is rounding."""

Groups = Int64[np.ndarray, "groups 4"]


def whole_kernels(aperture: Aperture, below_px: float) -> Exact:
    """Kernels up to a little more than this diameter, behind the focus and, turned, in front, and the aperture for all others."""
    above_px = below_px * 7.0 / 6.0
    levels = int(np.ceil((above_px - 1.0) * LEVELS_PER_PX)) + 1
    behind = _stacked([aperture.rasterize(1.0 + level / LEVELS_PER_PX).kernel.astype(np.float32) for level in range(levels + 1)])
    kernels = np.stack([behind, behind[:, ::-1, ::-1]])
    low, high, radius = kernels[:, :-1], kernels[:, 1:], behind.shape[1] // 2
    groups, counts = _groups((np.abs(low) > _NOTHING) | (np.abs(high) > _NOTHING))
    tables = _taps(low, groups), _taps(high - low, groups), *_laid(groups, radius)
    start = np.cumsum([0, *counts])
    return Exact(*tables, start, levels, radius, LEVELS_PER_PX, below_px, above_px, *aperture.packed(), aperture.unit_radius)


def _stacked(kernels: Sequence[Float32[np.ndarray, "_ _"]]) -> Float32[np.ndarray, "kernels size size"]:
    """Each in the middle of as many pixels as the last, the largest, has."""
    stacked = np.zeros((len(kernels), *kernels[-1].shape), np.float32)
    for whole, kernel in zip(stacked, kernels, strict=True):
        border = (len(whole) - len(kernel)) // 2
        whole[border : border + len(kernel), border : border + len(kernel)] = kernel
    return stacked


def _groups(seen: Bool[np.ndarray, "turns levels size size"]) -> tuple[Groups, Int64[np.ndarray, " kernels"]]:
    """Turn, level, row and first column of the groups of neighbours that cover all that is seen of each row, from its first to its last;
    and how many each kernel has."""
    first, last = seen.argmax(axis=3), seen.shape[3] - 1 - seen[..., ::-1].argmax(axis=3)
    of_row = np.where(seen.any(axis=3), (last - first) // BLENDED_CELLS + 1, 0)
    where = np.repeat(np.argwhere(of_row), of_row[of_row > 0], axis=0)
    before = np.arange(len(where)) - np.repeat(np.cumsum(of_row[of_row > 0]) - of_row[of_row > 0], of_row[of_row > 0])
    return np.column_stack([where, first[tuple(where.T)] + before * BLENDED_CELLS]), of_row.sum(axis=2).reshape(-1)


def _laid(groups: Groups, radius: int) -> tuple[UInt64[np.ndarray, " groups"], Int64[np.ndarray, " groups"]]:
    """Rows from the first of the kernels on, and columns from the pixel's on, in numbers of four channels."""
    return groups[:, 2].astype(np.uint64), 4 * (groups[:, 3] - radius)


def _taps(kernels: Float32[np.ndarray, "turns levels size size"], groups: Groups) -> Float32[np.ndarray, " taps"]:
    """All taps of every group, 0 beyond the kernel."""
    padded = np.pad(kernels, ((0, 0), (0, 0), (0, 0), (0, BLENDED_CELLS - 1)))
    turn, level, row, column = groups.T
    return padded[turn[:, None], level[:, None], row[:, None], column[:, None] + np.arange(BLENDED_CELLS)].reshape(-1)
