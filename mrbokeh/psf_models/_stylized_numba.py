"""Rays through a picture, compiled: lens points are drawn in proportion to its light."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def _inverted(cumulative: np.ndarray, share: float) -> float:
    """Where a rising polyline over 0, 1, 2, ... reaches `share`."""
    low = int(np.searchsorted(cumulative, share, side="right")) - 1
    low = min(max(low, 0), len(cumulative) - 2)
    rise = cumulative[low + 1] - cumulative[low]
    return low + (min((share - cumulative[low]) / rise, 1.0) if rise > 0.0 else 0.0)


@njit(cache=True, nogil=True)
def trace_picture(
    kernel: np.ndarray,
    low_px: float,
    high_px: float,
    shares: np.ndarray,
    origin: np.ndarray,
    unit: float,
    rows: np.ndarray,
    columns: np.ndarray,
) -> int:
    """Count rays (rays, 3) in kernel (K, K) for diameters from low to high; returns how many landed.

    origin (x, y): the centre of the pupil in the picture; unit: pupil radii per pixel of the picture. rows (H + 1) and columns
    (H, W + 1): light above each row, and left of each column within a row, both from 0 to 1.
    """
    size = kernel.shape[0]
    centre = 0.5 * size
    landed = 0
    for ray in range(len(shares)):
        y = _inverted(rows, shares[ray, 0])
        x = _inverted(columns[min(int(y), len(columns) - 1)], shares[ray, 1])
        half_px = 0.5 * (low_px + (high_px - low_px) * shares[ray, 2])
        column = int(np.floor(centre + half_px * unit * (x - origin[0])))
        row = int(np.floor(centre + half_px * unit * (y - origin[1])))
        if 0 <= row < size and 0 <= column < size:
            kernel[row, column] += 1.0
            landed += 1
    return landed
