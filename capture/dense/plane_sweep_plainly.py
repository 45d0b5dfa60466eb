"""The plane sweep in the open: world points, projected and sampled, window by window. The truth that the fast twins are tested against."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from capture.dense.plane_sweep import Matching
from capture.dense.sweep_view import SweepView
from capture.poses.sparse_model import distorted_px, undistorted_px

Score = Float[np.ndarray, "height width"]


def scores_of_surface(reference: SweepView, neighbours: Sequence[SweepView], dioptre: Score, matching: Matching) -> Score:
    """Mean correlation with the best neighbours if the points of the reference lie at `dioptre` (H, W); NaN where none sees them."""
    each = np.stack([_correlation(reference, neighbour, dioptre, matching) for neighbour in neighbours])
    best_first = -np.sort(-each, axis=0)[: matching.best_of(len(neighbours))]
    seen = np.isfinite(best_first)
    total = np.where(seen, best_first, 0.0).sum(axis=0)
    return np.divide(total, seen.sum(axis=0), out=np.full(total.shape, np.nan), where=seen.any(axis=0))


def _correlation(reference: SweepView, neighbour: SweepView, dioptre: Score, matching: Matching) -> Score:
    from scipy.ndimage import map_coordinates

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
