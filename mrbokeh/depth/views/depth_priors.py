"""Priors on a viewpoint's depth besides its neighbours' pictures: focus, depths at single points, and finished depths of other views.

Focus votes on the planes of a sweep. It is metric and sees what only one view sees, but it is coarse, and wrong around highlights,
where the rim of a highlight's disc outweighs the scene. So it votes only if its peak lies between slices, is sharp and above the
noise, and no highlight is near.

Finished depths of other views are checked for consistency: a surface seen by one view must be seen by the others, or be hidden.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

from mrbokeh.depth.views.sweep_view import SweepView, neighbour_from_reference, rays_of
from mrbokeh.distortion.radial import distorted_px

Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]

OVER_RANGE = 0.95
SHARE_OF_FOCUS = 0.2
_SHARP_CURVATURE = 0.3
_USUAL_CURVATURE = 0.36  # the median where focus is trusted, on a traced desk in 12 slices
_E_FOLDS_OF_FULL_COST = 2.0
_MOST_CONFIDENCE = 0.5  # of the pixels that focus trusts most, one in seven of a traced desk is off by 0.05 dioptre
_BAND_ROWS = 64
Count = Int[np.ndarray, "height width"]
_TRUSTED = 0.5


@dataclass(frozen=True)
class FocusVote:
    """Depth from focus as a vote.

    dioptre (H, W): where each pixel is sharpest. trust (H, W) in [0, 1]. curvature (H, W): twice the e-folds of energy lost one slice
    away. step_dioptre: between two slices.
    """

    dioptre: Plane
    trust: Plane
    curvature: Plane
    step_dioptre: float

    def resized(self, width_px: int, height_px: int) -> "FocusVote":
        """Resize by nearest neighbour, so that depths are not averaged over an edge."""
        if self.dioptre.shape == (height_px, width_px):
            return self

        def at(values: Plane) -> Float32[np.ndarray, "rows columns"]:
            return cv2.resize(values, (width_px, height_px), interpolation=cv2.INTER_NEAREST)

        return FocusVote(at(self.dioptre), at(self.trust), at(self.curvature), self.step_dioptre)


def focus_vote_of_map(focus_index: Plane, confidence: Plane, slice_dioptres: Float[np.ndarray, " slices"]) -> FocusVote:
    """Return the vote of a merged stack's depth from focus: its confidence is the trust, which is 0 at the ends of the stack."""
    interior = (focus_index > 0.5) & (focus_index < len(slice_dioptres) - 1.5)
    curvature = np.full_like(focus_index, _USUAL_CURVATURE)
    trust = np.where(interior, confidence, 0.0).astype(np.float32)
    dioptre = np.interp(focus_index, np.arange(len(slice_dioptres)), slice_dioptres).astype(np.float32)
    return FocusVote(dioptre, trust, curvature, float(np.abs(np.diff(slice_dioptres)).mean()))


def near_highlights(rgb: Float32[np.ndarray, "height width 3"], largest_coc_px: float) -> Mask:
    """Mark pixels of an all-in-focus picture within the largest blur (a diameter, so half of it) of anything over range."""
    over = (rgb.max(axis=2) > OVER_RANGE).astype(np.uint8)
    radius = int(np.ceil(0.5 * largest_coc_px)) + 1
    return cv2.dilate(over, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))).astype(bool)


def add_focus_votes(costs: UInt8[np.ndarray, "height width planes"], planes: Float[np.ndarray, " planes"], vote: FocusVote) -> None:
    """Blend the vote into the costs of a sweep in place: they keep 1 - SHARE_OF_FOCUS, and trusted focus adds the rest.

    Its cost grows with the square of the distance from its peak, like the parabola through its log energy.
    """
    for first in range(0, len(costs), _BAND_ROWS):
        rows = np.s_[first : first + _BAND_ROWS]
        steps = (planes.astype(np.float32) - vote.dioptre[rows, :, None]) / np.float32(vote.step_dioptre)
        lost = 0.5 * vote.curvature[rows, :, None] * steps**2
        focus = vote.trust[rows, :, None] * np.minimum(lost / _E_FOLDS_OF_FULL_COST, 1.0)
        costs[rows] = ((1.0 - SHARE_OF_FOCUS) * costs[rows] + SHARE_OF_FOCUS * 255.0 * focus + 0.5).astype(np.uint8)


def agreement(vote: FocusVote, dioptre: Plane) -> Plane:
    """Return how far focus supports a depth, 0 to 1: its trust less the energy it loses there."""
    steps = (dioptre - vote.dioptre) / np.float32(vote.step_dioptre)
    return (_MOST_CONFIDENCE * vote.trust * np.exp(-0.5 * np.maximum(vote.curvature, _SHARP_CURVATURE) * steps**2)).astype(np.float32)


@dataclass(frozen=True)
class ViewDepth:
    """A neighbour with its finished depth: dioptre (H, W), confidence (H, W) in [0, 1]."""

    view: SweepView
    dioptre: Plane
    confidence: Plane


@dataclass(frozen=True)
class Consistency:
    """Agreement with other views. supports (H, W): neighbours with the same surface; contradictions: those that see something farther.

    A neighbour with something nearer in the way counts as neither.
    """

    supports: Count
    contradictions: Count


def consistency(reference: SweepView, dioptre: Plane, neighbours: Sequence[ViewDepth], tolerance_dioptre: float) -> Consistency:
    """Compare 1 / depth along each neighbour's own axis; only confident pixels of a neighbour count."""
    supports, contradictions = np.zeros(dioptre.shape, np.int64), np.zeros(dioptre.shape, np.int64)
    rays = rays_of(reference)
    for first in range(0, len(rays), _BAND_ROWS):
        rows = np.s_[first : first + _BAND_ROWS]
        directions = np.concatenate([rays[rows], np.ones_like(rays[rows, :, :1])], axis=-1).astype(np.float64)
        for each in neighbours:
            there, expected = _seen_by(reference, directions / dioptre[rows, :, None], each)
            supports[rows] += np.abs(there - expected) <= tolerance_dioptre
            contradictions[rows] += there < expected - tolerance_dioptre
    return Consistency(supports, contradictions)


def _seen_by(reference: SweepView, points: np.ndarray, neighbour: ViewDepth) -> tuple[np.ndarray, np.ndarray]:
    """Return (the neighbour's dioptre where it sees the points, NaN if it has none; the dioptre expected there)."""
    camera = neighbour.view.camera
    pose = neighbour_from_reference(reference.camera, camera)
    in_camera = points @ pose[:3, :3].T + pose[:3, 3]
    depth = np.where(in_camera[..., 2] > 1e-6, in_camera[..., 2], np.nan)
    pinhole = in_camera[..., :2] / depth[..., None] * camera.focal_px + camera.principal_px
    samples = (distorted_px(camera, neighbour.view.distortion, pinhole) - 0.5).astype(np.float32)
    known = np.where(neighbour.confidence >= _TRUSTED, neighbour.dioptre, np.nan).astype(np.float32)
    x, y = np.nan_to_num(samples[..., 0], nan=-10.0), np.nan_to_num(samples[..., 1], nan=-10.0)
    return cv2.remap(known, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan")), 1.0 / depth


@dataclass(frozen=True)
class SparseDepths:
    """Depths known at single points: xy_px (K, 2) in the picture, depth_m (K,) along the axis."""

    xy_px: Float[np.ndarray, "points 2"]
    depth_m: Float[np.ndarray, " points"]

    def dioptre_range(self, margin: float = 0.15) -> tuple[float, float]:
        """Return (farthest, nearest) without the outermost percent, widened by a fraction of itself on either side."""
        farthest, nearest = np.percentile(1.0 / self.depth_m, [1.0, 99.0])
        spare = margin * (nearest - farthest)
        return max(float(farthest - spare), 0.0), float(nearest + spare)

    def joined(self, other: "SparseDepths") -> "SparseDepths":
        return SparseDepths(np.concatenate([self.xy_px, other.xy_px]), np.concatenate([self.depth_m, other.depth_m]))

    def pixels(self, shape: tuple[int, int], scale: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return (row, column, number) of the points inside a picture (height, width) at that scale."""
        column, row = np.floor(self.xy_px * scale).astype(int).T
        chosen = np.flatnonzero((column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0]))
        return row[chosen], column[chosen], chosen

    def add_anchors(self, costs: UInt8[np.ndarray, "height width planes"], planes: Float[np.ndarray, " planes"], scale: float) -> None:
        """Rule out in place all planes but the few around a known depth at its pixel. scale: of the costs' picture."""
        row, column, chosen = self.pixels(costs.shape[:2], scale)
        apart = np.abs(planes[None, :] - 1.0 / self.depth_m[chosen, None]) / (planes[1] - planes[0])
        costs[row, column] = np.where(apart > 2.0, 255, costs[row, column] // 2)


@dataclass(frozen=True)
class DepthPriors:
    """Everything known beside the pictures: focus, depths at single points, finished depths of neighbours (a second round)."""

    focus: FocusVote | None = None
    sparse: SparseDepths | None = None
    views: Sequence[ViewDepth] = ()
