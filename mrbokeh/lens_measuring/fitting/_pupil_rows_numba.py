"""Rows of the equations of a slice, compiled: what each cell of the pupil sees of the sharp picture from a blurred pixel."""

import numpy as np

from mrbokeh.system.compiled import njit

_STEPS = 3


@njit(cache=True, nogil=True)
def gather_rows(
    rows: np.ndarray, sums: np.ndarray, coc_px: np.ndarray, where: np.ndarray, turns: np.ndarray, places: np.ndarray, cell: float
) -> None:
    """Fill rows (R, C, cells) with the mean of the picture over the patch that sends its light through a cell to each pixel.

    sums (H + 1, W + 1, C): the picture summed from its corner. coc_px (H, W): signed diameters. where (R, 2): row and column of the
    pixels. turns (R, 2): cosine and sine of the angle by which the pupil is turned. places (cells, 2): x, y of the cells; cell: their
    width. Light from y through u arrives at y + coc(y) / 2 u, which is solved for y by repetition.
    """
    height, width = coc_px.shape
    channels = sums.shape[2]
    for r in range(where.shape[0]):
        row, column = where[r, 0], where[r, 1]
        cosine, sine = turns[r, 0], turns[r, 1]
        own = coc_px[row, column]
        for p in range(places.shape[0]):
            u = cosine * places[p, 0] - sine * places[p, 1]
            v = sine * places[p, 0] + cosine * places[p, 1]
            diameter = own
            x, y = column + 0.5, row + 0.5
            for _ in range(_STEPS):
                x, y = column + 0.5 - 0.5 * diameter * u, row + 0.5 - 0.5 * diameter * v
                diameter = coc_px[min(max(int(y), 0), height - 1), min(max(int(x), 0), width - 1)]
            half = max(0.25 * abs(diameter) * cell, 1e-3)
            left, right = min(max(x - half, 0.0), width - 2e-3), max(min(x + half, width - 0.0), 2e-3)
            top, bottom = min(max(y - half, 0.0), height - 2e-3), max(min(y + half, height - 0.0), 2e-3)
            area = (right - left) * (bottom - top)
            for c in range(channels):
                light = _sum_at(sums, bottom, right, c) - _sum_at(sums, top, right, c)
                light -= _sum_at(sums, bottom, left, c) - _sum_at(sums, top, left, c)
                rows[r, c, p] = light / area


@njit(cache=True, nogil=True, inline="always")
def _sum_at(sums: np.ndarray, y: float, x: float, channel: int) -> float:
    """Return the integral from the corner to a point between pixels: bilinear, because the picture is constant within each."""
    row, column = min(int(y), sums.shape[0] - 2), min(int(x), sums.shape[1] - 2)
    b, a = y - row, x - column
    upper = sums[row, column, channel] * (1.0 - a) + sums[row, column + 1, channel] * a
    lower = sums[row + 1, column, channel] * (1.0 - a) + sums[row + 1, column + 1, channel] * a
    return upper * (1.0 - b) + lower * b
