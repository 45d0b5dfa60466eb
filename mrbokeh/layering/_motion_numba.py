"""The loop over pixels of mrbokeh.layering.motion."""

import math

import numpy as np

from mrbokeh.system.kernels import njit

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
    """One place between four pixels."""
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
