"""Reasons to distrust a match-move, and the refusal of a camera that only rotates.

COLMAP finds models for such cameras: with a wrong focal length and distortion, rotating looks a little like walking around a point.
The simple explanation is tried too: all points at infinity, one rotation for each view, one focal length and one term of distortion,
by least squares on the pixels. If it fits as well, nothing tells where the camera was.
"""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
from jaxtyping import Float64, Int64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from capture.matchmove.frame_poses import FramePose
from capture.poses.sparse_model import SparseModel
from mrbokeh.system.errors import InputError

_MOST_POINTS = 300
_FOCAL_STARTS = (0.7, 1.0, 1.4)
"""Starting focal lengths over the model's, which is wrong if the camera only rotates."""
_ROTATES_AS_WELL = 3.0
"""Multiple of the model's residual up to which a rotation explains the clip: 1.2 for a rotating camera, 22 for a moving one."""
_ROTATES_PX = 0.25
"""Residual below which it does in any case: features are not placed better than that."""
_TOO_FEW_POINTS, _FEW_POINTS = 30, 150
_SMALL_PARALLAX_DEG = 4.0
_FEW_INLIERS = 0.8


def _points_of_keyframe(model: SparseModel) -> float:
    """Return the median number of points that a keyframe sees."""
    return float(np.median(np.bincount(model.observations[:, 0], minlength=len(model.views))))


def require_translation(clip: Path, model: SparseModel) -> None:
    """Raise InputError if the camera seems to have stayed at one place."""
    if (points := _points_of_keyframe(model)) < _TOO_FEW_POINTS:
        raise InputError(
            f"{clip}: COLMAP placed {len(model.views)} keyframes by {points:.0f} points each, too few to trust: film more texture with the "
            f"camera moving sideways (one that only rotates gives no points), or track a printed board"
        )
    rotating_px, model_px = rotation_only_residual_px(model), model_residual_px(model)
    if rotating_px < max(_ROTATES_AS_WELL * model_px, _ROTATES_PX):
        raise InputError(
            f"{clip}: the camera seems only to rotate (rotation alone explains the clip to {rotating_px:.2f} px, a path through space to "
            f"{model_px:.2f} px), so that nothing tells where it was: film with the camera moving sideways, or track a printed board"
        )


def quality_warnings(model: SparseModel, found: list[FramePose], parallax_deg: float) -> tuple[str, ...]:
    """Return warnings about a scene that moves, or a camera that hardly does."""
    points = _points_of_keyframe(model)
    fitting = float(np.median([pose.fitting for pose in found])) if found else 1.0
    left_out = len(model.left_out)
    told = (
        (points < _FEW_POINTS, f"a keyframe sees only {points:.0f} points of the model"),
        (parallax_deg < _SMALL_PARALLAX_DEG, f"points are seen under {parallax_deg:.1f} degrees only, so that depth is uncertain"),
        (fitting < _FEW_INLIERS, f"of the points carried into a frame only {100 * fitting:.0f} % move with the scene"),
        (left_out > 0, f"{left_out} of {left_out + len(model.views)} keyframes could not be placed"),
    )
    return tuple(text for doubtful, text in told if doubtful)


@dataclass(frozen=True)
class _Tracks:
    """Tracks of points. views, points: which view sees which point; offsets_px: position from the principal point."""

    views: Int64[np.ndarray, " seen"]
    points: Int64[np.ndarray, " seen"]
    offsets_px: Float64[np.ndarray, "seen 2"]
    view_count: int
    point_count: int


def rotation_only_residual_px(model: SparseModel) -> float:
    """Return the median reprojection error of a camera that only rotates."""
    tracks = _best_tracks(model)
    focal_px = model.views[0].camera.focal_px[0]
    fits = [_fitted(tracks, focal_px * factor) for factor in _FOCAL_STARTS]
    return min(float(np.median(np.linalg.norm(each.reshape(-1, 2), axis=1))) for each in fits)


def model_residual_px(model: SparseModel) -> float:
    """Return the median reprojection error of the model."""
    off = []
    for index, view in enumerate(model.views):
        seen = model.observations[:, 0] == index
        off.append(np.linalg.norm(view.project(model.points[model.observations[seen, 1]])[0] - model.observed_xy_px[seen], axis=1))
    return float(np.median(np.concatenate(off)))


def _best_tracks(model: SparseModel) -> _Tracks:
    """Return the points that most views see."""
    often = np.bincount(model.observations[:, 1], minlength=len(model.points))
    chosen = np.argsort(-often, kind="stable")[:_MOST_POINTS]
    kept = np.isin(model.observations[:, 1], chosen)
    views, points = model.observations[kept].T
    principal_px = np.array([view.camera.principal_px for view in model.views])
    _, numbered = np.unique(points, return_inverse=True)
    offsets_px = model.observed_xy_px[kept] - principal_px[views]
    return _Tracks(
        views=views.astype(np.int64),
        points=numbered.astype(np.int64),
        offsets_px=offsets_px,
        view_count=len(model.views),
        point_count=int(numbered.max()) + 1,
    )


def _fitted(tracks: _Tracks, focal_px: float) -> np.ndarray:
    """Fit the rotations and return the residuals, in pixels."""
    start = np.concatenate([[np.log(focal_px), 0.0], _chained(tracks, focal_px).as_rotvec()[1:].ravel()])
    bounds = np.full(len(start), np.inf)
    bounds[:2] = np.log(4.0), 1.0
    low, high = -bounds, bounds.copy()
    low[0], high[0] = np.log(focal_px) - bounds[0], np.log(focal_px) + bounds[0]
    solved = least_squares(_residuals, start, bounds=(low, high), loss="soft_l1", max_nfev=30, args=(tracks,))
    return _residuals(solved.x, tracks)


def _residuals(parameters: np.ndarray, tracks: _Tracks) -> np.ndarray:
    """Return the residuals in pixels; the direction of each point is the mean of the rays that see it."""
    focal_px, k1 = float(np.exp(parameters[0])), float(parameters[1])
    turns = Rotation.from_rotvec(np.concatenate([np.zeros(3), parameters[2:]]).reshape(-1, 3))[tracks.views]
    rays = turns.inv().apply(_rays(tracks.offsets_px / focal_px, k1))
    sums = np.stack([np.bincount(tracks.points, rays[:, axis], tracks.point_count) for axis in range(3)], axis=1)
    directions = turns.apply((sums / np.linalg.norm(sums, axis=1, keepdims=True))[tracks.points])
    plane = directions[:, :2] / np.maximum(directions[:, 2:], 0.05)
    bent = plane * (1.0 + k1 * np.sum(plane**2, axis=1, keepdims=True))
    return np.asarray((bent * focal_px - tracks.offsets_px).ravel())


def _rays(bent: Float64[np.ndarray, "seen 2"], k1: float) -> Float64[np.ndarray, "seen 3"]:
    """Return rays of length 1; distortion is removed by fixed-point iteration."""
    plane = bent
    for _ in range(8):
        plane = bent / np.maximum(1.0 + k1 * np.sum(plane**2, axis=1, keepdims=True), 0.2)
    rays = np.column_stack([plane, np.ones(len(plane))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _chained(tracks: _Tracks, focal_px: float) -> Rotation:
    """Return camera from world of each view, chained from view to view by their common points (Kabsch 1976)."""
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
