"""Loops over the pixels of a video frame, compiled: code values to linear light and back, 8-bit BGR to I420. They run without the GIL."""

import math

import numpy as np

from mrbokeh.system.compiled import njit

SHIFT = 16
"""The fractional bits of coefficients of `i420_from_bgr`."""


@njit(cache=True, nogil=True, inline="always")
def _look_up(table: np.ndarray, position: float) -> float:
    """Linear interpolation; beyond the ends the first or last step goes on."""
    step = min(max(int(position), 0), len(table) - 2)
    return table[step] + (position - step) * (table[step + 1] - table[step])


@njit(cache=True, nogil=True)
def linear_from_planes(
    y: np.ndarray, cb: np.ndarray, cr: np.ndarray, zeros: tuple, gains: tuple, matrix: tuple, table: np.ndarray, per_code: float
) -> np.ndarray:
    """Luma and chroma of full resolution, integer codes (H, W), to linear RGB float32 (H, W, 3).

    zeros, gains: code of zero and size of one code, of (luma, chroma). matrix: the four numbers by which chroma enters.
    table: linear light per code value; per_code: its entries per unit of code value.
    """
    height, width = y.shape
    out = np.empty((height, width, 3), np.float32)
    red_cr, green_cb, green_cr, blue_cb = matrix
    for j in range(height):
        for i in range(width):
            luma = (y[j, i] - zeros[0]) * gains[0]
            blue = (cb[j, i] - zeros[1]) * gains[1]
            red = (cr[j, i] - zeros[1]) * gains[1]
            out[j, i, 0] = _look_up(table, (luma + red_cr * red) * per_code)
            out[j, i, 1] = _look_up(table, (luma + green_cb * blue + green_cr * red) * per_code)
            out[j, i, 2] = _look_up(table, (luma + blue_cb * blue) * per_code)
    return out


@njit(cache=True, nogil=True)
def bgr8_from_planes(y: np.ndarray, cb: np.ndarray, cr: np.ndarray, zeros: tuple, gains: tuple, matrix: tuple) -> np.ndarray:
    """Convert like `linear_from_planes`, but to the code values themselves as 8 bit (H, W, 3), blue first, rounded."""
    height, width = y.shape
    out = np.empty((height, width, 3), np.uint8)
    red_cr, green_cb, green_cr, blue_cb = matrix
    for j in range(height):
        for i in range(width):
            luma = (y[j, i] - zeros[0]) * gains[0] * 255.0 + 0.5
            blue = (cb[j, i] - zeros[1]) * gains[1] * 255.0
            red = (cr[j, i] - zeros[1]) * gains[1] * 255.0
            out[j, i, 0] = min(max(int(luma + blue_cb * blue), 0), 255)
            out[j, i, 1] = min(max(int(luma + green_cb * blue + green_cr * red), 0), 255)
            out[j, i, 2] = min(max(int(luma + red_cr * red), 0), 255)
    return out


@njit(cache=True, nogil=True)
def planes_from_linear(
    rgb: np.ndarray, red_weight: float, blue_weight: float, floor: float, ceiling: float, table: np.ndarray, per_linear: float
) -> tuple:
    """Linear RGB (H, W, 3) to luma and colour differences (H, W) float32: luma of white is 1, differences lie in +-0.5.

    Each colour's code value is kept in [floor, ceiling] first.
    """
    height, width = rgb.shape[:2]
    y, cb, cr = np.empty((height, width), np.float32), np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for j in range(height):
        for i in range(width):
            red = min(max(_look_up(table, rgb[j, i, 0] * per_linear), floor), ceiling)
            green = min(max(_look_up(table, rgb[j, i, 1] * per_linear), floor), ceiling)
            blue = min(max(_look_up(table, rgb[j, i, 2] * per_linear), floor), ceiling)
            luma = red_weight * red + (1.0 - red_weight - blue_weight) * green + blue_weight * blue
            y[j, i] = luma
            cb[j, i] = (blue - luma) / (2.0 * (1.0 - blue_weight))
            cr[j, i] = (red - luma) / (2.0 * (1.0 - red_weight))
    return y, cb, cr


@njit(cache=True, nogil=True)
def codes_from_linear(channel: np.ndarray, largest: float, table: np.ndarray, per_linear: float) -> np.ndarray:
    """One linear colour (H, W) to integer codes from 0 to `largest`, rounded and clipped, uint16 (H, W)."""
    height, width = channel.shape
    out = np.empty((height, width), np.uint16)
    for j in range(height):
        for i in range(width):
            code = _look_up(table, channel[j, i] * per_linear) * largest
            out[j, i] = math.floor(min(max(code, 0.0), largest) + 0.5)
    return out


@njit(cache=True, nogil=True)
def i420_from_bgr(bgr: np.ndarray, y: np.ndarray, u: np.ndarray, v: np.ndarray, coefficients: np.ndarray, floor: int) -> None:
    """Fill y (H, >= W), u and v (H/2, >= W/2) from bgr (H, W, 3), whose last odd row and column are left out.

    coefficients: (3, 3) integers, rows for y, u and v, columns for blue, green and red, in units of 2**-SHIFT. floor: the code of black.
    Chroma is that of the mean of 2x2 pixels. Sums are rounded to nearest, halves up.
    """
    luma_base = (floor << SHIFT) + (1 << (SHIFT - 1))
    chroma_base = (128 << (SHIFT + 2)) + (1 << (SHIFT + 1))
    for j in range(bgr.shape[0] // 2):
        for i in range(bgr.shape[1] // 2):
            blue, green, red = np.int64(0), np.int64(0), np.int64(0)
            for dj in range(2):
                for di in range(2):
                    b = np.int64(bgr[2 * j + dj, 2 * i + di, 0])
                    g = np.int64(bgr[2 * j + dj, 2 * i + di, 1])
                    r = np.int64(bgr[2 * j + dj, 2 * i + di, 2])
                    luma = coefficients[0, 0] * b + coefficients[0, 1] * g + coefficients[0, 2] * r + luma_base
                    y[2 * j + dj, 2 * i + di] = luma >> SHIFT
                    blue += b
                    green += g
                    red += r
            cb = coefficients[1, 0] * blue + coefficients[1, 1] * green + coefficients[1, 2] * red + chroma_base
            cr = coefficients[2, 0] * blue + coefficients[2, 1] * green + coefficients[2, 2] * red + chroma_base
            u[j, i] = min(max(cb >> (SHIFT + 2), 0), 255)
            v[j, i] = min(max(cr >> (SHIFT + 2), 0), 255)
