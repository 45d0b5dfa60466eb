"""The last step of dense depth: edges moved onto those of the picture, confidence, focus where views fail, gaps filled.

Confidence comes from the agreement of views, the lead over the next best plane, focus, and other views' depths.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from capture.dense.depth_priors import Consistency, DepthPriors, FocusVote, agreement, consistency
from capture.dense.guided_depth import interpolate, near_steps, weighted_medians
from capture.dense.sweep_view import BRIGHTEST, SweepView

Plane = Float32[np.ndarray, "height width"]

_MARGIN_OF_HALF = 20.0
_LEAST_SCORE, _FULL_SCORE = 0.2, 0.8
_CONTRADICTED = 0.2
Rgb = Float32[np.ndarray, "height width 3"]
SWEEP, FOCUS, FILLED = 0, 1, 2
"""What a pixel's depth came from."""
LEAST_TRUST, DOUBTFUL = 0.05, 0.5
# In gaps the labelling is a better guess than far surroundings, the more it prefers one plane; focus is a better one still.
_SAY_OF_LABELLING = 0.05
_MARGIN_OF_HALF_SAY = 5.0
_LEAST_SAY = 1e-6
_SAY_OF_FOCUS = 0.01
_OTHER_SLICE, _SURE_OF_ANOTHER, _BEYOND_DOUBT = 1.5, 0.15, 0.95


@dataclass(frozen=True)
class FinishSettings:
    """Settings of the last step.

    edge_radius_px: how far windows may spill over an edge. step_dioptre: a step of depth between neighbouring pixels that counts as
    an edge. fill_px: how far gaps are filled evenly.
    """

    edge_radius_px: int = 6
    step_dioptre: float = 0.03
    fill_px: float = 20.0


@dataclass(frozen=True)
class Surface:
    """The surface found by the sweeps: dioptre, score (correlation) and margin (lead of the plane over all others), each (H, W)."""

    dioptre: Plane
    score: Plane
    margin: Plane


@dataclass(frozen=True)
class DenseDepth:
    """The result: depth_m (H, W) along the axis, everywhere; confidence (H, W) in [0, 1]; source (H, W): SWEEP, FOCUS or FILLED."""

    depth_m: Plane
    confidence: Plane
    source: UInt8[np.ndarray, "height width"]


def finished(rgb: Rgb, reference: SweepView, found: Surface, priors: DepthPriors, settings: FinishSettings) -> DenseDepth:
    """Move edges onto those of the picture, compute the confidence and fill gaps."""
    guide = cv2.bilateralFilter(np.sqrt(np.clip(rgb, 0.0, BRIGHTEST)), 5, 0.05, 1.5)
    edges = near_steps(found.dioptre, settings.edge_radius_px - 1, settings.step_dioptre)
    dioptre = weighted_medians(found.dioptre, np.ones_like(found.margin), guide, edges, settings.edge_radius_px, 0.07)
    moved = np.abs(dioptre - found.dioptre) > 0.5 * settings.step_dioptre
    by_views = np.where(moved, 0.5, 1.0).astype(np.float32) * sweep_trust(found.score, found.margin)
    by_focus = np.zeros_like(found.margin) if priors.focus is None else agreement(priors.focus, dioptre)
    trust = either(by_views, by_focus)
    if priors.views:
        trust = with_consistency(trust, consistency(reference, dioptre, priors.views, 0.5 * settings.step_dioptre))
    if priors.focus is not None:
        alone = _where_focus_knows_better(priors.focus, trust, dioptre)
        dioptre, trust = np.where(alone, priors.focus.dioptre, dioptre), np.where(alone, np.minimum(priors.focus.trust, DOUBTFUL), trust)
        by_focus[alone] = 1.0
    keep = np.clip((trust - LEAST_TRUST) / 0.2, 0.0, 1.0)
    filled = _filled(dioptre, trust, found.margin, guide, priors, settings.fill_px)
    source = np.where(keep < 0.5, FILLED, np.where(by_focus > by_views, FOCUS, SWEEP)).astype(np.uint8)
    return DenseDepth((1.0 / (keep * dioptre + (1.0 - keep) * filled)).astype(np.float32), trust, source)


def _where_focus_knows_better(focus: FocusVote, trust: Plane, dioptre: Plane) -> Bool[np.ndarray, "height width"]:
    """Mark pixels where focus replaces the views' depth.

    First, pixels that views do not support, mostly because no neighbour sees them: there one pixel in two is off by 0.05 dioptres on
    traced scenes, of those that focus trusts one in ten. Second, pixels where focus is certain of a quite different slice while views
    are not beyond doubt: repeating patterns deceive a sweep over few neighbours.
    """
    unsure = (trust < DOUBTFUL) & (focus.trust > trust)
    elsewhere = np.abs(focus.dioptre - dioptre) > _OTHER_SLICE * focus.step_dioptre
    return unsure | (elsewhere & (focus.trust > _SURE_OF_ANOTHER) & (trust < _BEYOND_DOUBT))


def _filled(dioptre: Plane, trust: Plane, margin: Plane, guide: Rgb, priors: DepthPriors, fill_px: float) -> Plane:
    """Spread trusted pixels over the others, up to the edges of the guide; known points count in full.

    Where nothing is trusted the labelling has a small weight, or focus, which errs less often there.
    """
    weights = trust**2 + _SAY_OF_LABELLING * margin / (margin + _MARGIN_OF_HALF_SAY) + _LEAST_SAY
    known = dioptre.copy()
    if priors.focus is not None:
        weak = trust < LEAST_TRUST
        known[weak], weights[weak] = priors.focus.dioptre[weak], _SAY_OF_FOCUS
    if priors.sparse is not None:
        row, column, chosen = priors.sparse.pixels(dioptre.shape)
        known[row, column], weights[row, column] = 1.0 / priors.sparse.depth_m[chosen], 1.0
    return interpolate(known, weights.astype(np.float32), guide, fill_px**2, 0.03)


def sweep_trust(score: Plane, margin: Plane) -> Plane:
    """Return trust from 0 to 1. score: correlation of the windows; margin: lead of the plane over all others, as in `Labels`.

    Measured on traced scenes: with a margin below 50 one pixel in four is wrong, above it one in a hundred.
    """
    agreeing = np.clip((score - _LEAST_SCORE) / (_FULL_SCORE - _LEAST_SCORE), 0.0, 1.0)
    return (agreeing * margin / (margin + _MARGIN_OF_HALF)).astype(np.float32)


def either(a: Plane, b: Plane) -> Plane:
    """Combine the trust of two independent sources."""
    return (1.0 - (1.0 - a) * (1.0 - b)).astype(np.float32)


def with_consistency(trust: Plane, seen: Consistency) -> Plane:
    """Raise the trust if another view has the same surface, and lower it if more views see through it than have it."""
    supported = np.where(seen.supports > 0, 1.0 - 0.5 * (1.0 - trust), trust)
    return np.where(seen.contradictions > seen.supports, _CONTRADICTED * trust, supported).astype(np.float32)
