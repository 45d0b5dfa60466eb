"""The loops over pixels of mrbokeh.distortion.warping."""

import math

import numpy as np

from mrbokeh.system.compiled import njit

_compiled = njit(cache=True, nogil=True, error_model="numpy", _nrt=False)
"""Without counting references, as mrbokeh.scene's kernels: nothing is allocated in here and the arrays outlive the call."""


@_compiled
def resample(
    source: np.ndarray,
    depth_m: np.ndarray,
    positions_px: np.ndarray,
    first_motion: int,
    total: np.ndarray,
    out: np.ndarray,
    out_depth_m: np.ndarray,
) -> None:
    """Write means of source (H, W, C; coverage in channel 3) over boxes around positions_px (h + 2, w + 2, 2) to out (h, w, C).

    total: (C,) float64, room for sums.
    """
    height, width, channels = out.shape
    for y in range(height):
        for x in range(width):
            at_x, at_y = positions_px[y + 1, x + 1, 0], positions_px[y + 1, x + 1, 1]
            xx = 0.5 * (positions_px[y + 1, x + 2, 0] - positions_px[y + 1, x, 0])
            xy = 0.5 * (positions_px[y + 2, x + 1, 0] - positions_px[y, x + 1, 0])
            yx = 0.5 * (positions_px[y + 1, x + 2, 1] - positions_px[y + 1, x, 1])
            yy = 0.5 * (positions_px[y + 2, x + 1, 1] - positions_px[y, x + 1, 1])
            if not (math.isfinite(at_x + xx + xy) and math.isfinite(at_y + yx + yy)):
                continue
            half_width, half_height = 0.5 * max(1.0, math.sqrt(xx * xx + xy * xy)), 0.5 * max(1.0, math.sqrt(yx * yx + yy * yy))
            nearest_m = _add_box(source, depth_m, at_x, at_y, half_width, half_height, total)
            if nearest_m < 0.0:
                continue
            out_depth_m[y, x] = nearest_m
            for c in range(channels):
                out[y, x, c] = total[c]
            determinant = xx * yy - xy * yx
            if first_motion >= 0 and determinant != 0.0:
                right, down = total[first_motion], total[first_motion + 1]
                out[y, x, first_motion] = (yy * right - xy * down) / determinant
                out[y, x, first_motion + 1] = (xx * down - yx * right) / determinant


@_compiled
def _add_box(
    source: np.ndarray, depth_m: np.ndarray, at_x: float, at_y: float, half_width: float, half_height: float, total: np.ndarray
) -> float:
    """Write the mean over the box to total. Returns the depth of the covering pixel next to its middle: inf for none, -1 outside the
    source.
    """
    height, width, channels = source.shape
    left, right = max(int(math.floor(at_x - half_width)), 0), min(int(math.ceil(at_x + half_width)), width)
    top, bottom = max(int(math.floor(at_y - half_height)), 0), min(int(math.ceil(at_y + half_height)), height)
    if left >= right or top >= bottom:
        return -1.0
    for c in range(channels):
        total[c] = 0.0
    share = 0.25 / (half_width * half_height)
    least, nearest_m = math.inf, math.inf
    for j in range(top, bottom):
        down = share * (min(j + 1.0, at_y + half_height) - max(float(j), at_y - half_height))
        for i in range(left, right):
            weight = down * (min(i + 1.0, at_x + half_width) - max(float(i), at_x - half_width))
            if weight <= 0.0:
                continue
            for c in range(channels):
                total[c] += weight * source[j, i, c]
            if source[j, i, 3] > 0.0:
                distance = (i + 0.5 - at_x) ** 2 + (j + 0.5 - at_y) ** 2
                if distance < least or (distance == least and depth_m[j, i] < nearest_m):
                    least, nearest_m = distance, depth_m[j, i]
    return nearest_m
