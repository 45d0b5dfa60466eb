"""Reference implementations of the dense depth's compiled loops: plane sweep, semi-global labelling and weighted medians."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, UInt16
from scipy.ndimage import map_coordinates

from mrbokeh.depth.views.guided_depth import Costs, Guide, Mask, Penalties, Plane
from mrbokeh.depth.views.plane_sweep import Matching
from mrbokeh.depth.views.sweep_view import SweepView
from mrbokeh.distortion.radial import distorted_px, undistorted_px

DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1))
Score = Float[np.ndarray, "height width"]


def scores_of_surface(reference: SweepView, neighbours: Sequence[SweepView], dioptre: Score, matching: Matching) -> Score:
    """Return the mean correlation with the best neighbours if the reference's points lie at `dioptre` (H, W); NaN where none sees them.

    World points are projected and sampled one by one, and correlated window by window.
    """
    each = np.stack([_correlation(reference, neighbour, dioptre, matching) for neighbour in neighbours])
    best_first = -np.sort(-each, axis=0)[: matching.best_of(len(neighbours))]
    seen = np.isfinite(best_first)
    total = np.where(seen, best_first, 0.0).sum(axis=0)
    return np.divide(total, seen.sum(axis=0), out=np.full(total.shape, np.nan), where=seen.any(axis=0))


def _correlation(reference: SweepView, neighbour: SweepView, dioptre: Score, matching: Matching) -> Score:
    pixels = undistorted_px(reference.camera, reference.distortion, reference.camera.pixel_centres_px())
    points_m = reference.camera.unproject(pixels, 1.0 / dioptre)
    xy_px, _ = neighbour.camera.project(points_m)
    x, y = np.moveaxis(distorted_px(neighbour.camera, neighbour.distortion, xy_px) - 0.5, -1, 0)
    height, width = neighbour.structure.shape
    seen = (x >= 0) & (y >= 0) & (x <= width - 1) & (y <= height - 1)
    warped = map_coordinates(neighbour.structure.astype(np.float64), [y, x], order=1, mode="nearest")
    return np.where(seen, _windows_correlated(reference.structure.astype(np.float64), warped, matching), np.nan)


def _windows_correlated(a: Score, b: Score, matching: Matching) -> Score:
    result, radius, noise = np.empty(a.shape), matching.radius_px, matching.noise**2
    for y, x in np.ndindex(*a.shape):
        window = np.s_[max(y - radius, 0) : y + radius + 1, max(x - radius, 0) : x + radius + 1]
        covariance = np.mean((a[window] - a[window].mean()) * (b[window] - b[window].mean()))
        result[y, x] = covariance / np.sqrt((a[window].var() + noise) * (b[window].var() + noise))
    return result


def aggregate_reference(costs: Costs, guide: Plane, penalties: Penalties) -> UInt16[np.ndarray, "height width planes"]:
    """Return the sums of path costs over eight directions, pixel by pixel."""
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
    """Return Hirschmueller's Eq. 13: the least of all ways to each label, less the cheapest of the pixel before."""
    penalty = np.where(jumps == 0, 0.0, np.where(jumps == 1, small, large))
    return (before[None, :] + penalty).min(axis=1) - before.min()


def weighted_medians_reference(values: Plane, weights: Plane, guide: Guide, where: Mask, radius_px: int, contrast: float) -> Plane:
    """Return the weighted median of the window of each marked pixel, pixel by pixel."""
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
