"""Loop over pixels of mrbokeh.compositing.edge_refinement, compiled."""

import numpy as np

from mrbokeh.system.kernels import njit

_ROUND = 1e-12
_SPREAD = 6e-5
"""Least variance of a side, in a scale in which the mean level is a half: that of a noise of 3 %."""


@njit(cache=True, nogil=True)
def nearness(
    found: np.ndarray,
    places: np.ndarray,
    rgb: np.ndarray,
    sides: np.ndarray,
    half_px: int,
    first: int,
    end: int,
) -> None:
    """Rows first to end of found (N, 2): where the pixel's colour lies from the far side's mean (0) to the near one's (1) on Fisher's
    line, and the square of the distance of the means in standard deviations; 0 where one side has no pixel in the window.

    sides (H, W): 1 certainly near, 2 certainly far, 0 neither.
    """
    height, width = sides.shape
    sums, mixed = np.empty((3, 4)), np.empty((3, 3))
    for i in range(first, end):
        y, x = places[i] // width, places[i] % width
        top, bottom, left, right = max(0, y - half_px), min(height, y + half_px + 1), max(0, x - half_px), min(width, x + half_px + 1)
        level = _level(rgb, sides, top, bottom, left, right)
        sums[:], mixed[:] = 0.0, 0.0
        _means(sums, rgb, sides, top, bottom, left, right, level)
        found[i, 0], found[i, 1] = 0.0, 0.0
        if sums[1, 3] < 1.0 or sums[2, 3] < 1.0 or level <= 0.0:
            continue
        _spread(mixed, sums, rgb, sides, top, bottom, left, right, level)
        a, b, c = sums[1, 0] - sums[2, 0], sums[1, 1] - sums[2, 1], sums[1, 2] - sums[2, 2]
        u, v, w = _solved(mixed, a, b, c)
        apart = u * a + v * b + w * c
        along = 0.0
        for channel, line in enumerate((u, v, w)):
            value = rgb[y, x, channel]
            along += line * (value / (value + level) - sums[2, channel])
        found[i, 0], found[i, 1] = along / max(apart, _ROUND), apart


@njit(cache=True, nogil=True)
def _level(rgb: np.ndarray, sides: np.ndarray, top: int, bottom: int, left: int, right: int) -> float:
    """Mean light of the pixels that belong to a side."""
    total, count = 0.0, 0
    for y in range(top, bottom):
        for x in range(left, right):
            if sides[y, x] != 0:
                total += rgb[y, x, 0] + rgb[y, x, 1] + rgb[y, x, 2]
                count += 3
    return total / count if count > 0 else 0.0


@njit(cache=True, nogil=True)
def _means(sums: np.ndarray, rgb: np.ndarray, sides: np.ndarray, top: int, bottom: int, left: int, right: int, level: float) -> None:
    """Mean compressed colour of each side, and how many pixels it has."""
    for y in range(top, bottom):
        for x in range(left, right):
            side = sides[y, x]
            if side != 0:
                sums[side, 3] += 1.0
                for c in range(3):
                    sums[side, c] += rgb[y, x, c] / (rgb[y, x, c] + level)
    for side in range(1, 3):
        for c in range(3):
            sums[side, c] /= max(sums[side, 3], 1.0)


@njit(cache=True, nogil=True)
def _spread(
    mixed: np.ndarray, means: np.ndarray, rgb: np.ndarray, sides: np.ndarray, top: int, bottom: int, left: int, right: int, level: float
) -> None:
    """Covariance within a side, the mean of both."""
    for y in range(top, bottom):
        for x in range(left, right):
            side = sides[y, x]
            if side != 0:
                share = 0.5 / means[side, 3]
                for c in range(3):
                    off = rgb[y, x, c] / (rgb[y, x, c] + level) - means[side, c]
                    for d in range(c + 1):
                        mixed[c, d] += share * off * (rgb[y, x, d] / (rgb[y, x, d] + level) - means[side, d])
    for c in range(3):
        mixed[c, c] += _SPREAD
        for d in range(c):
            mixed[d, c] = mixed[c, d]


@njit(cache=True, nogil=True)
def _solved(matrix: np.ndarray, a: float, b: float, c: float) -> tuple[float, float, float]:
    """Solve three equations by cofactors."""
    m = matrix
    p, q, r = m[1, 1] * m[2, 2] - m[1, 2] ** 2, m[0, 2] * m[1, 2] - m[0, 1] * m[2, 2], m[0, 1] * m[1, 2] - m[0, 2] * m[1, 1]
    s, t, u = m[0, 0] * m[2, 2] - m[0, 2] ** 2, m[0, 1] * m[0, 2] - m[0, 0] * m[1, 2], m[0, 0] * m[1, 1] - m[0, 1] ** 2
    size = max(m[0, 0] * p + m[0, 1] * q + m[0, 2] * r, _ROUND * _ROUND)
    return (p * a + q * b + r * c) / size, (q * a + s * b + t * c) / size, (r * a + t * b + u * c) / size
