"""Dense metric depth of one viewpoint: neighbouring views and focus weighted by trust, edges kept, gaps filled.

A sweep over planes (at a resolution that bounds memory) and a semi-global labelling find the surfaces; sweeps of a few steps
around them, level by level up to the full picture, refine them; edges are moved onto those of the picture; pixels that neither
views nor focus determine are filled from their surroundings and have no confidence.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import cv2
import numpy as np
from jaxtyping import Float32

from capture.dense.depth_priors import DepthPriors, add_focus_votes
from capture.dense.finish import DenseDepth, FinishSettings, Surface, finished
from capture.dense.guided_depth import Penalties, label_planes
from capture.dense.plane_sweep import Costs, Matching, Refined, by_parallax, dioptre_planes, pixels_per_dioptre, plane_sweep, refine
from capture.dense.sweep_view import SweepView

_FACTOR = 2.0
Plane = Float32[np.ndarray, "height width"]
Rgb = Float32[np.ndarray, "height width 3"]
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
    from capture.dense.torch_plane_sweep import plane_sweep_on

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
