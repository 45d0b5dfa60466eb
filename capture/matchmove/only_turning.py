"""Whether a camera that only turns explains the keyframes as well as the model in space that COLMAP made of them.

COLMAP finds such models: with a wrong focal length and distortion, turning about a point looks a little like walking around one.
The plain explanation is tried too: all points at infinity, one rotation for each view, one focal length and one term of distortion,
by least squares on the pixels. Where it does as well, nothing tells where the camera was.
"""

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float64, Int64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from capture.poses.sparse_model import SparseModel

_MOST_POINTS = 300
_FOCAL_STARTS = (0.7, 1.0, 1.4)
"""In focal lengths of the model, which is wrong where the camera only turns."""


@dataclass(frozen=True)
class _Tracks:
    """views, points: which view sees which point; offsets_px: where, from the principal point."""

    views: Int64[np.ndarray, " seen"]
    points: Int64[np.ndarray, " seen"]
    offsets_px: Float64[np.ndarray, "seen 2"]
    view_count: int
    point_count: int


def turning_residual_px(model: SparseModel) -> float:
    """Median distance between where points are seen and where a camera that only turns would see them; inf where it explains nothing."""
    tracks = _best_tracks(model)
    focal_px = model.views[0].camera.focal_px[0]
    fits = [_fitted(tracks, focal_px * factor) for factor in _FOCAL_STARTS]
    return min(float(np.median(np.linalg.norm(each.reshape(-1, 2), axis=1))) for each in fits)


def model_residual_px(model: SparseModel) -> float:
    """The same of the model itself."""
    off = []
    for index, view in enumerate(model.views):
        seen = model.observations[:, 0] == index
        off.append(np.linalg.norm(view.project(model.points[model.observations[seen, 1]])[0] - model.observed_xy_px[seen], axis=1))
    return float(np.median(np.concatenate(off)))


def _best_tracks(model: SparseModel) -> _Tracks:
    """Points that most views see."""
    often = np.bincount(model.observations[:, 1], minlength=len(model.points))
    chosen = np.argsort(-often, kind="stable")[:_MOST_POINTS]
    kept = np.isin(model.observations[:, 1], chosen)
    views, points = model.observations[kept].T
    principal_px = np.array([view.camera.principal_px for view in model.views])
    _, numbered = np.unique(points, return_inverse=True)
    offsets_px = model.observed_xy_px[kept] - principal_px[views]
    return _Tracks(views.astype(np.int64), numbered.astype(np.int64), offsets_px, len(model.views), int(numbered.max()) + 1)


def _fitted(tracks: _Tracks, focal_px: float) -> np.ndarray:
    """What remains, in pixels."""
    start = np.concatenate([[np.log(focal_px), 0.0], _chained(tracks, focal_px).as_rotvec()[1:].ravel()])
    bounds = np.full(len(start), np.inf)
    bounds[:2] = np.log(4.0), 1.0
    low, high = -bounds, bounds.copy()
    low[0], high[0] = np.log(focal_px) - bounds[0], np.log(focal_px) + bounds[0]
    solved = least_squares(_residuals, start, bounds=(low, high), loss="soft_l1", max_nfev=30, args=(tracks,))
    return _residuals(solved.x, tracks)


def _residuals(parameters: np.ndarray, tracks: _Tracks) -> np.ndarray:
    """In pixels; the direction of each point is the mean of the rays that see it."""
    focal_px, k1 = float(np.exp(parameters[0])), float(parameters[1])
    turns = Rotation.from_rotvec(np.concatenate([np.zeros(3), parameters[2:]]).reshape(-1, 3))[tracks.views]
    rays = turns.inv().apply(_rays(tracks.offsets_px / focal_px, k1))
    sums = np.stack([np.bincount(tracks.points, rays[:, axis], tracks.point_count) for axis in range(3)], axis=1)
    directions = turns.apply((sums / np.linalg.norm(sums, axis=1, keepdims=True))[tracks.points])
    plane = directions[:, :2] / np.maximum(directions[:, 2:], 0.05)
    bent = plane * (1.0 + k1 * np.sum(plane**2, axis=1, keepdims=True))
    return np.asarray((bent * focal_px - tracks.offsets_px).ravel())


def _rays(bent: Float64[np.ndarray, "seen 2"], k1: float) -> Float64[np.ndarray, "seen 3"]:
    """Of length 1; distortion taken out by fixed point."""
    plane = bent
    for _ in range(8):
        plane = bent / np.maximum(1.0 + k1 * np.sum(plane**2, axis=1, keepdims=True), 0.2)
    rays = np.column_stack([plane, np.ones(len(plane))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _chained(tracks: _Tracks, focal_px: float) -> Rotation:
    """camera from world of each view, from view to view by the points that both see (Kabsch 1976)."""
    rays = _rays(tracks.offsets_px / focal_px, 0.0)
    turns = [Rotation.identity()]
    for one, other in pairwise(range(tracks.view_count)):
        in_one, in_other = (np.flatnonzero(tracks.views == view) for view in (one, other))
        _, first, second = np.intersect1d(tracks.points[in_one], tracks.points[in_other], return_indices=True)
        step = Rotation.identity()
        if len(first) >= 3:
            step = Rotation.align_vectors(rays[in_other[second]], rays[in_one[first]])[0]
        turns.append(step * turns[-1])
    return Rotation.concatenate(turns)
