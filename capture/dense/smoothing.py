"""Fast global smoother (Min et al. 2014): smoothing that stops at the edges of a guide, in time linear in the pixels.

Weighted least squares, split into solves along rows and columns with less smoothness each time (their Algorithm 2). OpenCV has
it in ximgproc, which the headless package does not hold.
"""

from functools import partial

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.system.workers import in_bands, workers

Plane = Float32[np.ndarray, "height width"]

ROUNDS = 3
_LEAST_BAND = 32


def smooth(
    values: Float32[np.ndarray, "height width channels"],
    guide: Float32[np.ndarray, "height width colours"],
    smoothness: float,
    contrast: float,
) -> Float32[np.ndarray, "height width channels"]:
    """Values (H, W, C) smoothed within what the guide shows as one surface; their mean over a closed region stays.

    smoothness: lambda of the paper; a lone value in an even region reaches about sqrt(lambda) pixels.
    contrast: a difference of the guide by this much lets 1/e through.
    """
    from capture.dense._smoothing_numba import solve_columns, solve_rows

    result = np.ascontiguousarray(values, dtype=np.float32).copy()
    height, width, _ = result.shape
    across, down = _links(guide, 1, contrast), _links(guide, 0, contrast)
    with workers(height * width) as pool:
        for strength in round_strengths(smoothness):
            in_bands(pool, height, _LEAST_BAND, partial(solve_rows, result, across, strength))
            in_bands(pool, width, _LEAST_BAND, partial(solve_columns, result, down, strength))
    return result


def round_strengths(smoothness: float) -> list[float]:
    """lambda of each round (Eq. 12 of the paper): falling by 4, so that streaks of one direction are wiped out by the next."""
    return [1.5 * 4.0 ** (ROUNDS - t) / (4.0**ROUNDS - 1.0) * smoothness for t in range(1, ROUNDS + 1)]


def _links(guide: Float32[np.ndarray, "height width colours"], axis: int, contrast: float) -> Float32[np.ndarray, "rows columns"]:
    return np.exp(-np.linalg.norm(np.diff(guide, axis=axis), axis=-1) / contrast).astype(np.float32)


def smooth_plainly(
    values: Float32[np.ndarray, "height width channels"],
    guide: Float32[np.ndarray, "height width colours"],
    smoothness: float,
    contrast: float,
) -> Float[np.ndarray, "height width channels"]:
    """The same by full matrices, one line at a time: the plain twin of `smooth`."""
    result = values.astype(np.float64)
    across, down = _links(guide, 1, contrast), _links(guide, 0, contrast)
    for strength in round_strengths(smoothness):
        for y in range(result.shape[0]):
            result[y] = np.linalg.solve(_line_matrix(across[y], strength), result[y])
        for x in range(result.shape[1]):
            result[:, x] = np.linalg.solve(_line_matrix(down[:, x], strength), result[:, x])
    return result


def _line_matrix(links: Float[np.ndarray, " links"], strength: float) -> Float[np.ndarray, "line line"]:
    """Identity plus strength times the graph Laplacian of a line."""
    differences = np.diff(np.eye(len(links) + 1), axis=0)
    return np.eye(len(links) + 1) + strength * differences.T @ (links[:, None] * differences)


def interpolate(
    values: Plane, weights: Plane, guide: Float32[np.ndarray, "height width colours"], smoothness: float, contrast: float
) -> Plane:
    """Values smoothed by their weights in [0, 1]: what has none is filled from its surroundings (Min et al. 2014, section V-C)."""
    known = np.where(weights > 0, values, 0.0) * weights
    both = smooth(np.stack([known, weights], axis=-1).astype(np.float32), guide, smoothness, contrast)
    return both[..., 0] / np.maximum(both[..., 1], 1e-12)
