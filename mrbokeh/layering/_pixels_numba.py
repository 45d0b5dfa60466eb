"""Compiled loops over the pixels of one layer, before it is cut into slices: highlights, paths of motion, the box that is lit, margins."""

import math

import numpy as np

from mrbokeh.system.compiled import njit

_MOST = 13  # of 25


@njit(cache=True, nogil=True)
def mark_rows(lit: np.ndarray, values: np.ndarray, ratio: np.float32, top: int, bottom: int) -> None:
    """Set rows top to bottom of lit (H, W): pixels of values (H, W, 3 or more) more than `ratio` times as bright as most of the 5x5 around.

    A pixel's brightness is its strongest channel. If most of the 25 are that much darker, so are most of at least one column: a pixel that
    is not `ratio` times the least of the columns' medians needs no count. That bound vectorises.
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
    """Set the medians of the 5 rows around y, padded by two pixels on either side; beyond the ends the last row or column is repeated."""
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


STEP_PX = 0.25
"""Places on a path are at most so far apart; each is shared out among the four pixels around it."""


@njit(cache=True, nogil=True)
def draw_out(
    values: np.ndarray, coc_px: np.ndarray, motion_px: np.ndarray, out: np.ndarray, coc_sum: np.ndarray, weight_sum: np.ndarray
) -> None:
    """Add every pixel's light along its path to out, and its coverage, plain and times coc_px, to the sums."""
    height, width, channels = values.shape
    for y in range(height):
        for x in range(width):
            is_lit = False
            for c in range(channels):
                is_lit = is_lit or values[y, x, c] != 0
            if not is_lit:
                continue
            right, down = motion_px[y, x, 0], motion_px[y, x, 1]
            places = 1 + int(math.ceil(max(abs(right), abs(down)) / STEP_PX))
            for k in range(places):
                time = (k + 0.5) / places - 0.5
                _put(values[y, x], coc_px[y, x], x + right * time, y + down * time, 1.0 / places, out, coc_sum, weight_sum)


@njit(cache=True, nogil=True)
def _put(
    value: np.ndarray, coc_px: float, x: float, y: float, share: float, out: np.ndarray, coc_sum: np.ndarray, weight_sum: np.ndarray
) -> None:
    """Add one place between four pixels to the sums."""
    height, width, channels = out.shape
    left, top = int(math.floor(x)), int(math.floor(y))
    for row in range(top, top + 2):
        down = 1.0 - abs(y - row)
        for column in range(left, left + 2):
            weight = share * down * (1.0 - abs(x - column))
            if weight > 0.0 and 0 <= row < height and 0 <= column < width:
                for c in range(channels):
                    out[row, column, c] += np.float32(weight * value[c])
                weight_sum[row, column] += np.float32(weight * value[3])
                coc_sum[row, column] += np.float32(weight * value[3] * coc_px)


@njit(cache=True, nogil=True, error_model="numpy", _nrt=False)
def widen(box: np.ndarray, flat: np.ndarray, channels: int) -> None:
    """Widen the box (top, bottom, left, right) so that it holds all pixels of the rows (H, W * channels) that are not 0."""
    height, count = flat.shape
    for y in range(height):
        touched = 0
        for i in range(count):  # without a way out, so that it runs on whole vectors
            touched += flat[y, i] != 0.0
        if touched == 0:
            continue
        first, last = 0, count - 1
        while flat[y, first] == 0.0:
            first += 1
        while flat[y, last] == 0.0:
            last -= 1
        box[0], box[1] = min(box[0], y), max(box[1], y + 1)
        box[2], box[3] = min(box[2], first // channels), max(box[3], last // channels + 1)


@njit(cache=True, nogil=True)
def put_side_by_side(values: np.ndarray, rgb: np.ndarray, alpha: np.ndarray, margin_px: int, top: int, bottom: int) -> None:
    """Copy rows top to bottom of rgb (H, W, 3) and alpha (H, W) into the first four channels of values, which has a margin all around."""
    width = alpha.shape[1]
    for y in range(top, bottom):
        for x in range(width):
            pixel = values[margin_px + y, margin_px + x]
            pixel[0], pixel[1], pixel[2], pixel[3] = rgb[y, x, 0], rgb[y, x, 1], rgb[y, x, 2], alpha[y, x]
