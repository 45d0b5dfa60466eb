"""Why a match-move may be wrong."""

from pathlib import Path

import numpy as np

from capture.matchmove.frame_poses import FramePose
from capture.matchmove.only_turning import model_residual_px, turning_residual_px
from capture.poses.sparse_model import SparseModel
from mrbokeh.system.errors import InputError

_TURNS_AS_WELL = 3.0
"""Times the model's residual up to which a camera that only turns explains the clip: 1.2 for one that does, 22 for one that walks."""

_TURNS_PX = 0.25
"""Below which it does in any case: features are not placed better than that."""

_TOO_FEW_POINTS, _FEW_POINTS = 30, 150
_SMALL_PARALLAX_DEG = 4.0
_FEW_INLIERS = 0.8


def _points_of_keyframe(model: SparseModel) -> float:
    """Median number that one sees."""
    return float(np.median(np.bincount(model.observations[:, 0], minlength=len(model.views))))


def require_walking(clip: Path, model: SparseModel) -> None:
    """Raises InputError where the camera seems to have stood at one place."""
    if (points := _points_of_keyframe(model)) < _TOO_FEW_POINTS:
        raise InputError(
            f"{clip}: COLMAP placed {len(model.views)} keyframes by {points:.0f} points each, too few to trust: film more texture with the "
            f"camera moving sideways (one that only turns gives no points), or track a printed board"
        )
    turning_px, model_px = turning_residual_px(model), model_residual_px(model)
    if turning_px < max(_TURNS_AS_WELL * model_px, _TURNS_PX):
        raise InputError(
            f"{clip}: the camera seems only to turn (turning alone explains what it sees to {turning_px:.2f} px, a way through space to "
            f"{model_px:.2f} px), so that nothing tells where it was: film with the camera moving sideways, or track a printed board"
        )


def doubts(model: SparseModel, found: list[FramePose], parallax_deg: float) -> tuple[str, ...]:
    """In words: what a scene at rest and a moving camera do not show."""
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
