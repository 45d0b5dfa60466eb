"""Loop over 2x2 pixels from 8-bit BGR to I420, compiled; it runs without the GIL."""

import numpy as np

from mrbokeh.system.compiled import njit

SHIFT = 16


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
