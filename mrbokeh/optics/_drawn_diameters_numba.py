"""The table of mrbokeh.optics.drawn_diameters, looked up pixel by pixel without a branch so that it vectorises."""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def look_up(drawn: np.ndarray, coc_px: np.ndarray, table: np.ndarray, steps_per_px: int) -> None:
    """Signed diameters of float32; between two steps of the table linearly, beyond the last by the difference of its squares."""
    last, steps = np.int32(len(table) - 1), np.float32(steps_per_px)
    widest = np.float32(last) / steps
    less = widest * widest - table[last] * table[last]
    for i in range(len(coc_px)):
        size = abs(coc_px[i])
        at = min(size, widest) * steps
        lower = max(min(np.int32(at), last - np.int32(1)), np.int32(0))
        near = table[lower] + (at - np.float32(lower)) * (table[lower + 1] - table[lower])
        wide = np.float32(math.sqrt(max(size * size - less, np.float32(0.0))))
        meant = near if size < widest else wide
        drawn[i] = meant if coc_px[i] >= np.float32(0.0) else -meant
