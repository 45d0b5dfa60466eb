"""The screen-space Gaussian as a recursive filter along x and a plain one along a sheared axis (Eq. 9 and 10)."""

import math

import numpy as np

from mrbokeh.renderers.layered_reconstruction._filter_numba import axes, sheared_axes
from mrbokeh.system.kernels import njit

_LEAST_VARIANCE = 1e-3


@njit(cache=True, nogil=True)
def feedback(variance_px2: float) -> float:
    """gamma of Eq. 10, such that forward and backward together have exactly this variance.

    The impulse response of both is (1 - gamma) / (1 + gamma) gamma^|n| with variance 2 gamma / (1 - gamma)^2. The paper's
    exp(-sqrt(2) / sigma) is the same for large sigma and 15 % too narrow at 1 px.
    """
    q = 1.0 + 1.0 / variance_px2
    return q - math.sqrt(q * q - 1.0)


@njit(cache=True, nogil=True)
def recursive_rows(planes: np.ndarray, variance_px2: float, passes: int) -> None:
    """Smooth planes (h, w, C) in place along x; beyond the borders there is nothing.

    Several passes share the variance; their sum comes nearer to a Gaussian. Forward and backward are run as one sum of
    decaying exponentials, f + b - in, so that the result is mirror symmetric at the borders too.
    """
    if variance_px2 < _LEAST_VARIANCE:
        return
    gamma = np.float32(feedback(variance_px2 / passes))
    gain = np.float32((1.0 - gamma) / (1.0 + gamma))
    height, width, channels = planes.shape
    forward = np.empty((width, channels), np.float32)
    carried = np.empty(channels, np.float32)
    for y in range(height):
        row = planes[y]
        for _ in range(passes):
            for c in range(channels):
                carried[c] = 0.0
            for x in range(width):
                for c in range(channels):
                    carried[c] = row[x, c] + gamma * carried[c]
                    forward[x, c] = carried[c]
            for c in range(channels):
                carried[c] = 0.0
            for x in range(width - 1, -1, -1):
                for c in range(channels):
                    behind = gamma * carried[c]
                    carried[c] = row[x, c] + behind
                    row[x, c] = gain * (forward[x, c] + behind)


@njit(cache=True, nogil=True)
def sheared_taps(s_v: float, beta: float, guard_y: int) -> tuple[np.ndarray, np.ndarray, float]:
    """Weights along the sheared axis, the shift in x of each row, and the variance that linear interpolation adds along x."""
    weights, shifts = np.zeros(2 * guard_y + 1), np.zeros(2 * guard_y + 1)
    for j in range(-guard_y, guard_y + 1):
        weights[j + guard_y] = math.exp(-0.5 * (j / s_v) ** 2) if s_v > 1e-3 else (1.0 if j == 0 else 0.0)
        shifts[j + guard_y] = beta * j
    weights /= weights.sum()
    added = 0.0
    for j in range(len(weights)):
        part = shifts[j] - math.floor(shifts[j])
        added += weights[j] * part * (1.0 - part)
    return weights, shifts, added


@njit(cache=True, nogil=True)
def sheared_gaussian(
    out: np.ndarray, planes: np.ndarray, guard_x: int, guard_y: int, v_xx: float, v_xy: float, v_yy: float, passes: int
) -> None:
    """As direct_gaussian; uses planes up."""
    sigma_u, sigma_v, theta = axes(v_xx, v_xy, v_yy)
    s_u, s_v, beta = sheared_axes(sigma_u, sigma_v, theta)
    weights, shifts, added = sheared_taps(s_v, beta, guard_y)
    recursive_rows(planes, s_u * s_u - added, passes)
    height, width, channels = out.shape
    out[:] = 0.0
    last = planes.shape[1] - 1
    for j in range(len(weights)):
        weight = weights[j]
        if weight < 1e-6:
            continue
        whole = int(math.floor(shifts[j]))
        right = np.float32(weight * (shifts[j] - whole))
        left = np.float32(weight) - right
        for y in range(height):
            row = planes[y + j]
            for x in range(width):
                at = x + guard_x + whole
                if 0 <= at < last:
                    for c in range(channels):
                        out[y, x, c] += left * row[at, c] + right * row[at + 1, c]
                elif at == last:
                    for c in range(channels):
                        out[y, x, c] += left * row[at, c]
