"""Dense metric depth of one viewpoint: neighbouring views and focus weighted by trust, edges kept, gaps filled.

A sweep over planes (at a resolution that bounds memory) and a semi-global labelling find the surfaces; sweeps of a few steps
around them, level by level up to the full picture, refine them; edges are moved onto those of the picture; pixels that neither
views nor focus determine are filled from their surroundings and have no confidence.
Confidence comes from the agreement of views, the lead over the next best plane, focus, and other views' depths.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from mrbokeh.depth.depth_filters import interpolate
from mrbokeh.depth.views.depth_priors import Consistency, DepthPriors, FocusVote, add_focus_votes, agreement, consistency
from mrbokeh.depth.views.guided_depth import Penalties, label_planes, near_steps, weighted_medians
from mrbokeh.depth.views.plane_sweep import Costs, Matching, Refined, by_parallax, dioptre_planes, pixels_per_dioptre, plane_sweep, refine
from mrbokeh.depth.views.sweep_view import BRIGHTEST, SweepView

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


_FACTOR = 2.0
_LEAST_DIOPTRE = np.float32(1e-4)  # 10 km: nothing lies beyond infinity


@dataclass(frozen=True)
class DenseSettings:
    """Settings of dense depth.

    step_px: between planes, in the widest neighbour; most_planes caps their number (the sweeps around the surface are finer).
    most_cells: pixels times planes of the coarse level, at 3 bytes each.
    device: of torch, for the sweep over all planes ('cuda'); None takes the compiled loops.
    """

    step_px: float = 0.5
    finest_step_px: float = 1.0
    most_planes: int = 128
    coarse_neighbours: int = 4
    most_cells: int = 1 << 27
    matching: Matching = field(default_factory=lambda: Matching(radius_px=2, noise=0.01))
    fine_matching: Matching = field(default_factory=lambda: Matching(radius_px=3))
    penalties: Penalties = field(default_factory=Penalties)
    finish: FinishSettings = field(default_factory=FinishSettings)
    device: str | None = None


def dense_depth(
    rgb: Rgb,
    reference: SweepView,
    neighbours: Sequence[SweepView],
    dioptre_range: tuple[float, float],
    priors: DepthPriors | None = None,
    settings: DenseSettings | None = None,
) -> DenseDepth:
    """Return the depth of the reference. rgb: its all-in-focus picture, linear Rec.709; dioptre_range: (farthest, nearest) in 1 / metres.

    Raises InputError if no neighbour shows parallax.
    """
    priors, settings = priors or DepthPriors(), settings or DenseSettings()
    planes = dioptre_planes(reference, neighbours, dioptre_range, settings.step_px, settings.most_planes)
    neighbours = by_parallax(reference, neighbours, dioptre_range)
    height, width = reference.structure.shape
    sizes = level_sizes(width, height, len(planes), settings.most_cells)
    dioptre, margin = _coarse(reference, neighbours[: settings.coarse_neighbours], planes, sizes[0], priors, settings)
    step = float(planes[1] - planes[0])
    finest = settings.finest_step_px / max(pixels_per_dioptre(reference, each, dioptre_range[1], dioptre_range[0]) for each in neighbours)
    for size in sizes:
        dioptre, margin = (_resized(each, size) for each in (dioptre, margin))
        views = [_at(each, width, size) for each in neighbours]
        for finer in halvings(step, finest * width / size[0]):
            fine = _refined(_at(reference, width, size), views, cv2.medianBlur(dioptre, 5), finer, settings)
            dioptre, step = fine.dioptre, finer
    return finished(rgb, reference, Surface(fine.dioptre, fine.score, margin), priors, settings.finish)


def _coarse(
    reference: SweepView,
    neighbours: Sequence[SweepView],
    planes: np.ndarray,
    size: tuple[int, int],
    priors: DepthPriors,
    settings: DenseSettings,
) -> tuple[Plane, Plane]:
    """Return (dioptre, margin) from labelling all planes at the coarsest level."""
    width = reference.structure.shape[1]
    small = _at(reference, width, size)
    costs = _sweep_of(settings.device)(small, [_at(each, width, size) for each in neighbours], planes, settings.matching)
    if priors.focus is not None:
        add_focus_votes(costs, planes, priors.focus.resized(*size))
    if priors.sparse is not None:
        priors.sparse.add_anchors(costs, planes, size[0] / width)
    labels = label_planes(costs, small.structure, settings.penalties)
    return np.interp(labels.index, np.arange(len(planes)), planes).astype(np.float32), labels.margin


def _sweep_of(device: str | None) -> Callable[..., Costs]:
    if device is None:
        return plane_sweep
    from mrbokeh.depth.views.torch_plane_sweep import plane_sweep_on

    return partial(plane_sweep_on, device)


def _at(view: SweepView, full_width_px: int, size: tuple[int, int]) -> SweepView:
    """Resize a view to a level; the scale is that of the reference's width."""
    if size[0] == full_width_px:
        return view
    height, width = view.structure.shape
    return view.resized(*scaled_size((width, height), size[0] / full_width_px))


def _resized(values: Plane, size: tuple[int, int]) -> Float32[np.ndarray, "rows columns"]:
    """Resize without averaging depths over an edge."""
    return values if values.shape == size[::-1] else cv2.resize(values, size, interpolation=cv2.INTER_NEAREST)


def _refined(reference: SweepView, neighbours: Sequence[SweepView], dioptre: Plane, step: float, settings: DenseSettings) -> Refined:
    """Sweep finely around the surface; it stays as it was where views agree on nothing."""
    fine = refine(reference, neighbours, dioptre, step, matching=settings.fine_matching)
    return replace(fine, dioptre=np.maximum(np.where(fine.score > 0.0, fine.dioptre, dioptre), _LEAST_DIOPTRE))


def level_sizes(width_px: int, height_px: int, planes: int, most_cells: int) -> list[tuple[int, int]]:
    """Return (width, height) of the levels from the coarsest, of at most `most_cells` pixels times planes, to the full picture.

    Each finer level has at most twice the pixels a side.
    """
    shrink = max(1.0, np.sqrt(width_px * height_px * planes / most_cells))
    steps = int(np.ceil(np.log(shrink) / np.log(_FACTOR) - 1e-9))
    scales = [shrink ** (-(steps - k) / steps) for k in range(steps)] + [1.0] if steps else [1.0]
    widths = [max(int(width_px * scale), 1) if scale < 1.0 else width_px for scale in scales]
    return [scaled_size((width_px, height_px), width / width_px) for width in widths]


def scaled_size(size: tuple[int, int], scale: float) -> tuple[int, int]:
    """Return (width, height) in whole pixels."""
    return max(round(size[0] * scale), 1), max(round(size[1] * scale), 1)


def halvings(step: float, finest: float) -> list[float]:
    """Halve the step repeatedly down to `finest` or a little below; return at least one."""
    count = max(int(np.ceil(np.log2(step / finest) - 1e-9)), 1)
    return [step * 0.5 ** (k + 1) for k in range(count)]
