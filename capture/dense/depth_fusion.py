"""What focus says about depth, and where it may: a vote on the planes of a sweep.

Focus is metric and sees what only one view sees, but it is coarse, and wrong around lights: there the rim of a light's disc
outshouts the scene. So it votes only where its peak lies between slices, is sharp, stands above the noise, and no light is near.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8

Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]

OVER_RANGE = 0.95
SHARE_OF_FOCUS = 0.2
_SHARP_CURVATURE = 0.3
_USUAL_CURVATURE = 0.36  # the median where focus is trusted, on a traced desk in 12 slices
_E_FOLDS_OF_FULL_COST = 2.0
_MOST_CONFIDENCE = 0.5  # of the pixels that focus trusts most, one in seven of a traced desk is off by 0.05 dioptre
_BAND_ROWS = 64


@dataclass(frozen=True)
class FocusVote:
    """dioptre (H, W): where each pixel is sharpest; trust (H, W) in [0, 1]; curvature (H, W): e-folds of energy lost one slice away,
    twice; step_dioptre: between two slices."""

    dioptre: Plane
    trust: Plane
    curvature: Plane
    step_dioptre: float

    def resized(self, width_px: int, height_px: int) -> "FocusVote":
        """The vote of a smaller picture; the nearest pixel's, for depths are not averaged over an edge."""
        if self.dioptre.shape == (height_px, width_px):
            return self

        def at(values: Plane) -> Float32[np.ndarray, "rows columns"]:
            return cv2.resize(values, (width_px, height_px), interpolation=cv2.INTER_NEAREST)

        return FocusVote(at(self.dioptre), at(self.trust), at(self.curvature), self.step_dioptre)


def focus_vote_of_map(focus_index: Plane, confidence: Plane, slice_dioptres: Float[np.ndarray, " slices"]) -> FocusVote:
    """The vote of a finished depth from focus, as a merged stack keeps it: confidence stands for the trust, ends have none."""
    interior = (focus_index > 0.5) & (focus_index < len(slice_dioptres) - 1.5)
    curvature = np.full_like(focus_index, _USUAL_CURVATURE)
    trust = np.where(interior, confidence, 0.0).astype(np.float32)
    return FocusVote(_between(focus_index, slice_dioptres), trust, curvature, _step(slice_dioptres))


def _between(index: Float[np.ndarray, "height width"], slice_dioptres: Float[np.ndarray, " slices"]) -> Plane:
    return np.interp(index, np.arange(len(slice_dioptres)), slice_dioptres).astype(np.float32)


def _step(slice_dioptres: Float[np.ndarray, " slices"]) -> float:
    return float(np.abs(np.diff(slice_dioptres)).mean())


def near_lights(rgb: Float32[np.ndarray, "height width 3"], largest_coc_px: float) -> Mask:
    """Pixels of an all-in-focus picture within the largest blur (a diameter, so half of it) of anything over range."""
    over = (rgb.max(axis=2) > OVER_RANGE).astype(np.uint8)
    radius = int(np.ceil(0.5 * largest_coc_px)) + 1
    return cv2.dilate(over, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))).astype(bool)


def add_focus_votes(costs: UInt8[np.ndarray, "height width planes"], planes: Float[np.ndarray, " planes"], vote: FocusVote) -> None:
    """Blend into the costs of a sweep, in place: everywhere they keep 1 - SHARE_OF_FOCUS, and focus adds the rest where it is trusted.

    Its cost grows with the square of the distance from its peak, as the parabola through its log energy says.
    """
    for first in range(0, len(costs), _BAND_ROWS):
        rows = np.s_[first : first + _BAND_ROWS]
        steps = (planes.astype(np.float32) - vote.dioptre[rows, :, None]) / np.float32(vote.step_dioptre)
        lost = 0.5 * vote.curvature[rows, :, None] * steps**2
        focus = vote.trust[rows, :, None] * np.minimum(lost / _E_FOLDS_OF_FULL_COST, 1.0)
        costs[rows] = ((1.0 - SHARE_OF_FOCUS) * costs[rows] + SHARE_OF_FOCUS * 255.0 * focus + 0.5).astype(np.uint8)


def agreement(vote: FocusVote, dioptre: Plane) -> Plane:
    """From 0 to 1: how far focus vouches for a depth: its trust, less what its energy lost there."""
    steps = (dioptre - vote.dioptre) / np.float32(vote.step_dioptre)
    return (_MOST_CONFIDENCE * vote.trust * np.exp(-0.5 * np.maximum(vote.curvature, _SHARP_CURVATURE) * steps**2)).astype(np.float32)
