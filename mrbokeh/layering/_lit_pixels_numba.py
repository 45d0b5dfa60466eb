"""The search of mrbokeh.layering.lit_pixels, compiled: a bound that vectorises, then a count where the bound does not decide."""

import numpy as np

from mrbokeh.system.kernels import njit

_MOST = 13  # of 25


@njit(cache=True, nogil=True)
def find_lit(lit: np.ndarray, values: np.ndarray, ratio: np.float32, top: int, bottom: int) -> None:
    """Rows top to bottom of lit (H, W): pixels of values (H, W, 3 or more) more than `ratio` times as bright as most of the 5x5 around.

    A pixel's brightness is its strongest channel. Where most of 5 columns of 5 are that much darker, most of one column are; so one
    that is not so much brighter than the least of the columns' medians needs no count.
    """
    height, width, _ = values.shape
    first, end = max(0, top - 2), min(height, bottom + 2)
    brightness = np.empty((end - first, width), np.float32)
    for y in range(first, end):
        for x in range(width):
            brightness[y - first, x] = max(max(values[y, x, 0], values[y, x, 1]), values[y, x, 2])
    medians = np.empty(width + 4, np.float32)
    for y in range(top, bottom):
        _medians_of_columns(medians, brightness, y - first)
        here, found = brightness[y - first], lit[y]
        for x in range(width):
            least = min(min(min(medians[x], medians[x + 1]), min(medians[x + 2], medians[x + 3])), medians[x + 4])
            found[x] = here[x] > ratio * least
        for x in range(width):
            if found[x]:
                found[x] = _over_most(brightness, y - first, x, ratio)


@njit(cache=True, nogil=True)
def _medians_of_columns(medians: np.ndarray, brightness: np.ndarray, y: int) -> None:
    """The medians of the 5 rows around y, two pixels on the left; beyond the ends the last row or column is repeated."""
    rows, width = brightness.shape
    a, b, c = brightness[max(y - 2, 0)], brightness[max(y - 1, 0)], brightness[y]
    d, e = brightness[min(y + 1, rows - 1)], brightness[min(y + 2, rows - 1)]
    inner = medians[2 : width + 2]
    for x in range(width):
        low, high = max(min(a[x], b[x]), min(d[x], e[x])), min(max(a[x], b[x]), max(d[x], e[x]))
        inner[x] = max(min(low, high), min(max(low, high), c[x]))
    medians[0] = medians[1] = medians[2]
    medians[width + 2] = medians[width + 3] = medians[width + 1]


@njit(cache=True, nogil=True)
def _over_most(brightness: np.ndarray, y: int, x: int, ratio: np.float32) -> bool:
    rows, width = brightness.shape
    darker = 0
    for ny in range(y - 2, y + 3):
        for nx in range(x - 2, x + 3):
            darker += ratio * brightness[min(max(ny, 0), rows - 1), min(max(nx, 0), width - 1)] < brightness[y, x]
    return darker >= _MOST
