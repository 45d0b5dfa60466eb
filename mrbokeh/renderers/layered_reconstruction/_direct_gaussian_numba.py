"""The screen-space Gaussian in the open, every pixel from every other: the slow twin of the fast filters."""

import math

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True)
def direct_gaussian(out: np.ndarray, planes: np.ndarray, guard_x: int, guard_y: int, v_xx: float, v_xy: float, v_yy: float) -> None:
    """Fill out (h, w, C) from planes (h + 2 guard_y, w + 2 guard_x, C) by the Gaussian of covariance V, sampled at pixels, sum 1."""
    det = v_xx * v_yy - v_xy * v_xy
    kernel = np.zeros((2 * guard_y + 1, 2 * guard_x + 1), np.float32)
    if det > 1e-9:
        for j in range(-guard_y, guard_y + 1):
            for i in range(-guard_x, guard_x + 1):
                kernel[j + guard_y, i + guard_x] = math.exp(-0.5 * (v_yy * i * i - 2.0 * v_xy * i * j + v_xx * j * j) / det)
        kernel /= kernel.sum()
    else:
        kernel[guard_y, guard_x] = 1.0
    height, width, channels = out.shape
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                out[y, x, c] = 0.0
            for j in range(2 * guard_y + 1):
                for i in range(2 * guard_x + 1):
                    weight = kernel[j, i]
                    if weight > 0.0:
                        for c in range(channels):
                            out[y, x, c] += weight * planes[y + j, x + i, c]
