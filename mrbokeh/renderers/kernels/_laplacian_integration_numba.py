"""Tridiagonal sweeps of mrbokeh.renderers.kernels.laplacian_integration, compiled: one system per sine mode, modes side by side."""

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True)
def pivots(diagonal: np.ndarray, height: int) -> np.ndarray:
    """(height, modes) reciprocal pivots of Thomas's elimination for rows -u[y-1] + diagonal u[y] - u[y+1]; diagonal (modes,) >= 2."""
    modes = diagonal.shape[0]
    out = np.empty((height, modes))
    for k in range(modes):
        out[0, k] = 1.0 / diagonal[k]
    for y in range(1, height):
        for k in range(modes):
            out[y, k] = 1.0 / (diagonal[k] - out[y - 1, k])
    return out


@njit(cache=True, nogil=True)
def solve_columns(modes: np.ndarray, pivot: np.ndarray, scale: np.ndarray, first: int, end: int) -> None:
    """Overwrite the right-hand sides modes[:, first:end] (H, K, C), times scale (K,), with the solutions; zero beyond both ends."""
    height, _, channels = modes.shape
    for y in range(height):
        for k in range(first, end):
            factor, onwards = scale[k] * pivot[y, k], pivot[y, k]
            for c in range(channels):
                before = modes[y - 1, k, c] if y > 0 else modes.dtype.type(0)
                modes[y, k, c] = factor * modes[y, k, c] + onwards * before
    for y in range(height - 2, -1, -1):
        for k in range(first, end):
            onwards = pivot[y, k]
            for c in range(channels):
                modes[y, k, c] += onwards * modes[y + 1, k, c]
