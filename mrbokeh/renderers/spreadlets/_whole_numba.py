"""Sums in whole numbers, compiled: how large they can be, and back to reals."""

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True)
def largest_sum(points: np.ndarray, weights: np.ndarray, reach_px: int) -> float:
    """What no sum of points (N, 2) times light of at most 1 exceeds, whichever cell every pixel around takes."""
    side = 2 * reach_px + 1
    most = np.zeros((side, side))
    for n in range(len(weights)):
        y, x = points[n, 1] + reach_px, points[n, 0] + reach_px
        most[y, x] = max(most[y, x], abs(weights[n]))
    return most.sum()


@njit(cache=True, nogil=True)
def to_reals(whole: np.ndarray, reals: np.ndarray, gains: np.ndarray) -> None:
    """reals (h, w, LANES) = whole (h, w, LANES) over gains (LANES,), powers of two; they may lie in the same memory."""
    height, width, lanes = whole.shape
    row, unit = np.empty(width * lanes, np.float32), np.empty(width * lanes, np.float32)
    for i in range(len(unit)):
        unit[i] = 1.0 / gains[i % lanes]
    for y in range(height):
        source, target = whole[y].reshape(-1), reals[y].reshape(-1)
        for i in range(len(row)):
            row[i] = source[i]
        for i in range(len(row)):
            target[i] = row[i] * unit[i]
