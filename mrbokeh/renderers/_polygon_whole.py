"""Tables of the kernels that polygon_differences splats whole: small ones by levels of diameter, as groups of neighbouring taps."""

from itertools import pairwise

import numpy as np
from jaxtyping import Float32, Int, Int64, UInt64

from mrbokeh.aperture import Aperture
from mrbokeh.renderers._polygon_ring_numba import Exact
from mrbokeh.renderers._vectors_numba import BLENDED_CELLS

LEVELS_PER_PX = 8.0
"""Small kernels are tabulated this densely in diameter; between two they are blended, which is 1e-3 of their peak off."""
_NOTHING = 1e-9
"""Below this a tap of a kernel is rounding."""

Kernel = Float32[np.ndarray, "size size"]


def whole_kernels(aperture: Aperture, below_px: float) -> Exact:
    """Kernels up to a little more than this diameter, behind the focus and, turned, in front, and the aperture for all others."""
    above_px = below_px * 7.0 / 6.0
    levels = int(np.ceil((above_px - 1.0) * LEVELS_PER_PX)) + 1
    kernels = [aperture.rasterize(1.0 + level / LEVELS_PER_PX).kernel.astype(np.float32) for level in range(levels + 1)]
    radius = kernels[-1].shape[0] // 2
    kernels = [np.pad(kernel, radius - kernel.shape[0] // 2) for kernel in kernels]
    places, lower, rise = [], [], []
    for turn in (1, -1):
        for low, high in pairwise(kernel[::turn, ::turn] for kernel in kernels):
            place = _groups((np.abs(low) > _NOTHING) | (np.abs(high) > _NOTHING))
            places.append(place)
            lower.append(_taps(low, place))
            rise.append(_taps(high - low, place))
    start = np.cumsum([0, *(len(place) for place in places)])
    tables = np.concatenate(lower), np.concatenate(rise), *_laid(np.concatenate(places), radius)
    return Exact(*tables, start, levels, radius, LEVELS_PER_PX, below_px, above_px, *aperture.packed(), aperture.unit_radius)


def _groups(seen: np.ndarray) -> Int[np.ndarray, "groups 2"]:
    """Row and first column of the groups of neighbours that cover all that is seen of each row, from its first to its last."""
    spans = [(row, np.flatnonzero(taps)) for row, taps in enumerate(seen)]
    return np.array([(row, column) for row, taps in spans if taps.size for column in range(taps[0], taps[-1] + 1, BLENDED_CELLS)], np.int64)


def _laid(place: Int[np.ndarray, "groups 2"], radius: int) -> tuple[UInt64[np.ndarray, " groups"], Int64[np.ndarray, " groups"]]:
    """Rows from the first of the kernels on, and columns from the pixel's on, in numbers of four channels."""
    return place[:, 0].astype(np.uint64), 4 * (place[:, 1] - radius)


def _taps(kernel: Kernel, place: Int[np.ndarray, "groups 2"]) -> Float32[np.ndarray, " taps"]:
    """All taps of every group, 0 beyond the kernel."""
    padded = np.pad(kernel, ((0, 0), (0, BLENDED_CELLS - 1)))
    return np.stack([padded[place[:, 0], place[:, 1] + k] for k in range(BLENDED_CELLS)], axis=1).reshape(-1)
