"""Edges of a depth map moved onto the edges of the picture: windows see a near surface a little beyond where it ends.

From costs of planes to one plane per pixel: semi-global labelling (Hirschmueller 2008) that lets depth jump where the picture does.

Fast global smoother (Min et al. 2014): smoothing that stops at the edges of a guide, in time linear in the pixels.

Weighted least squares, split into solves along rows and columns with less smoothness each time (their Algorithm 2). OpenCV has
it in ximgproc, which the headless package does not hold.
"""

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8, UInt16

from mrbokeh.system.resources import in_bands, workers

Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Guide = Float32[np.ndarray, "height width colours"]

_LEAST_BAND = 32


def near_steps(values: Plane, radius_px: int, least: float) -> Mask:
    """Pixels with a step between neighbours of `least` or more within the radius."""
    steps = np.zeros(values.shape, np.uint8)
    steps[:, 1:] |= np.abs(np.diff(values, axis=1)) >= least
    steps[1:] |= np.abs(np.diff(values, axis=0)) >= least
    return cv2.dilate(steps, np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)).astype(bool)


def weighted_medians(values: Plane, weights: Plane, guide: Guide, where: Mask, radius_px: int, contrast: float) -> Plane:
    """Where asked for, the median of the window weighted by trust and by likeness of colour (Ma et al. 2013), else the value itself.

    contrast: a colour that differs by this much weighs 1/e.
    """
    from capture.dense import _guided_numba as compiled

    out = values.copy()
    height, width = values.shape
    fixed = values, weights, np.ascontiguousarray(guide), where, radius_px, contrast
    with workers(height * width) as pool:
        in_bands(pool, height, _LEAST_BAND, lambda first, end: compiled.weighted_medians(*fixed, (first, end), out))
    return out


def weighted_medians_plainly(values: Plane, weights: Plane, guide: Guide, where: Mask, radius_px: int, contrast: float) -> Plane:
    """The plain twin of `weighted_medians`."""
    out = values.copy()
    for y, x in zip(*np.nonzero(where), strict=True):
        window = np.s_[max(y - radius_px, 0) : y + radius_px + 1, max(x - radius_px, 0) : x + radius_px + 1]
        unlike = np.sum((guide[window] - guide[y, x]) ** 2, axis=-1)
        share = (weights[window] * np.exp(-unlike / contrast**2)).ravel()
        order = np.argsort(values[window].ravel())
        passed = np.cumsum(share[order])
        if passed[-1] > 0:
            out[y, x] = values[window].ravel()[order[np.argmax(passed >= 0.5 * passed[-1])]]
    return out


Costs = UInt8[np.ndarray, "height width planes"]

DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1))
_RIVAL_APART = 2


@dataclass(frozen=True)
class Penalties:
    """small: for a step to the next plane, large: for any farther one (both in units of cost, 255 is no agreement at all).

    contrast: where the guide changes by this much between two pixels, a jump of depth costs half.
    """

    small: float = 30.0
    large: float = 500.0
    contrast: float = 0.02


@dataclass(frozen=True)
class Labels:
    """index (H, W): fractional index of the plane; margin: how much dearer the best other plane is, per path, in units of cost."""

    index: Plane
    margin: Plane


def label_planes(costs: Costs, guide: Plane, penalties: Penalties | None = None) -> Labels:
    """The labelling of all pixels together. Memory: 2 bytes per cell beside the costs."""
    from capture.dense._guided_numba import aggregate, winners

    rules = penalties or Penalties()
    total = aggregate(costs, guide, rules.small, rules.large, rules.contrast)
    index, margin = (np.empty(guide.shape, np.float32) for _ in range(2))
    winners(total, _RIVAL_APART, index, margin)
    return Labels(index, margin / np.float32(len(DIRECTIONS)))


def aggregate_plainly(costs: Costs, guide: Plane, penalties: Penalties) -> UInt16[np.ndarray, "height width planes"]:
    """Sums of path costs over eight directions, pixel by pixel: the plain twin of `_dense_labelling_numba.aggregate`."""
    height, width, planes = costs.shape
    total = np.zeros(costs.shape, np.uint16)
    jumps = np.abs(np.arange(planes)[:, None] - np.arange(planes)[None, :])
    for dx, dy in DIRECTIONS:
        path = np.zeros(costs.shape)
        for y in range(height)[:: dy or 1]:
            for x in range(width)[:: dx or 1]:
                path[y, x] = costs[y, x]
                if 0 <= x - dx < width and 0 <= y - dy < height:
                    before = path[y - dy, x - dx]
                    edge = abs(float(guide[y, x]) - float(guide[y - dy, x - dx]))
                    large = max(penalties.large / (1.0 + edge / penalties.contrast), penalties.small)
                    path[y, x] += _cheapest_step(before, jumps, penalties.small, large)
        total += path.astype(np.uint16)
    return total


def _cheapest_step(before: Float[np.ndarray, " planes"], jumps: np.ndarray, small: float, large: float) -> Float[np.ndarray, " planes"]:
    """Hirschmueller's Eq. 13: the least of all ways to each label, less the cheapest of the pixel before."""
    penalty = np.where(jumps == 0, 0.0, np.where(jumps == 1, small, large))
    return (before[None, :] + penalty).min(axis=1) - before.min()


ROUNDS = 3


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
    from capture.dense._guided_numba import solve_columns, solve_rows

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
