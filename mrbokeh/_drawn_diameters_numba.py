"""The table of mrbokeh.drawn_diameters, looked up pixel by pixel."""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def look_up(drawn: np.ndarray, coc_px: np.ndarray, table: np.ndarray, steps_per_px: int) -> None:
    """Signed diameters of float32; between two steps of the table linearly, beyond the last by the difference of its squares."""
    last = len(table) - 1
    widest = np.float32(last) / np.float32(steps_per_px)
    less = widest * widest - table[last] * table[last]
    for i in range(len(coc_px)):
        size = abs(coc_px[i])
        if size <= np.float32(1.0):
            drawn[i] = coc_px[i]
            continue
        if size < widest:
            at = size * np.float32(steps_per_px)
            lower = int(at)
            meant = table[lower] + (at - np.float32(lower)) * (table[lower + 1] - table[lower])
        else:
            meant = np.float32(math.sqrt(size * size - less))
        drawn[i] = math.copysign(meant, coc_px[i])
