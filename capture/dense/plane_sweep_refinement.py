"""A second, fine sweep around a surface: windows slant with it, so that steep surfaces are matched as sharply as those that face us."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from capture.dense.plane_sweep import Matching, PlaneScores
from capture.poses.sweep_view import Plane, SweepView
from mrbokeh.system.workers import in_bands, workers

_LEAST_BAND = 32
_LEAST_CURVATURE = 1e-4


@dataclass(frozen=True)
class Refined:
    """dioptre (H, W); score: correlation there, -1..1 (-2 where no neighbour sees the point); curvature: how sharply the score falls
    off within a step, 0 where the best is at the end of the shell; there the dioptre is left as it was."""

    dioptre: Plane
    score: Plane
    curvature: Plane


def refine(
    reference: SweepView,
    neighbours: Sequence[SweepView],
    base_dioptre: Plane,
    step_dioptre: float,
    reach: int = 2,
    matching: Matching | None = None,
) -> Refined:
    """The best of 2 reach + 1 surfaces, step_dioptre apart, around base_dioptre, and between them by a parabola."""
    sweep = PlaneScores(reference, neighbours, matching or Matching(), base_dioptre)
    offsets = [step_dioptre * k for k in range(-reach, reach + 1)]
    result = Refined(*(np.empty_like(base_dioptre) for _ in range(3)))

    def fill(first: int, end: int) -> None:
        best, score, curvature = _peak(np.stack([sweep.of_rows(first, end, offset) for offset in offsets]))
        result.dioptre[first:end] = base_dioptre[first:end] + step_dioptre * (best - reach)
        result.score[first:end], result.curvature[first:end] = score, curvature

    height, width = base_dioptre.shape
    with workers(height * width) as pool:
        in_bands(pool, height, _LEAST_BAND, fill)
    return result


def _peak(
    scores: Float32[np.ndarray, "offsets rows width"],
) -> tuple[Float32[np.ndarray, "rows width"], Float32[np.ndarray, "rows width"], Float32[np.ndarray, "rows width"]]:
    """(fractional index of the peak, its score, its curvature); the middle index and curvature 0 where the peak is at an end."""
    best = scores.argmax(axis=0)
    middle, inside = len(scores) // 2, (best > 0) & (best < len(scores) - 1)
    at = np.where(inside, best, middle)
    before, here, after = (np.take_along_axis(scores, (at + k)[None], axis=0)[0] for k in (-1, 0, 1))
    curvature = np.where(inside, 2.0 * here - before - after, 0.0)
    offset = np.where(curvature > _LEAST_CURVATURE, 0.5 * (after - before) / np.maximum(curvature, _LEAST_CURVATURE), 0.0)
    return (at + np.clip(offset, -0.5, 0.5)).astype(np.float32), here, np.maximum(curvature, 0.0).astype(np.float32)
