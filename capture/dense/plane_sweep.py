"""Plane sweep in dioptres: how well neighbouring views agree with the reference if its points lay on each of many planes.

Collins 1996 (A space-sweep approach to true multi-image matching), with zero-mean normalised cross-correlation in windows and
the mean of the best few neighbours (Kang, Szeliski and Chai 2001), so that a view in which a point is hidden has no say.
Planes lie equally apart in dioptres: so do their pictures in a neighbour, and so does blur.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from capture.poses.sweep_view import Plane, SweepView, packed_view, rays_of
from mrbokeh.system.errors import InputError
from mrbokeh.system.workers import in_bands, workers

Costs = UInt8[np.ndarray, "height width planes"]

WORST_COST = 255
UNSEEN = -2.0
"""Score of a point that no neighbour sees."""
_LEAST_BAND = 32


@dataclass(frozen=True)
class Matching:
    """How windows are compared.

    radius_px: windows are squares of 2 radius + 1 pixels.
    best: how many neighbours count; 0 takes half of them, rounded up.
    noise: standard deviation of structure below which a window says little; its correlation is damped towards 0.
    """

    radius_px: int = 2
    best: int = 0
    noise: float = 0.004

    def best_of(self, neighbours: int) -> int:
        return min(self.best or (neighbours + 1) // 2, neighbours)


def plane_sweep(
    reference: SweepView,
    neighbours: Sequence[SweepView],
    offsets: Float[np.ndarray, " planes"],
    matching: Matching | None = None,
    base_dioptre: Plane | None = None,
) -> Costs:
    """(H, W, D) cost of each plane, 255 (1 - correlation) in 0..255: 0 agrees, 255 is uncorrelated or worse.

    offsets: the dioptres of the planes; with base_dioptre (H, W) they are added to it, which sweeps a shell around a surface and
      so compares slanted windows where the surface slants.
    Where no neighbour sees a point its cost is 255. Memory: 1 byte per cell and a band of rows of float32 scores.
    """
    matching = matching or Matching()
    height, width = reference.structure.shape
    base = np.zeros((height, width), np.float32) if base_dioptre is None else base_dioptre
    sweep = PlaneScores(reference, neighbours, matching, base)
    costs = np.empty((height, width, len(offsets)), np.uint8)

    def fill(first: int, end: int) -> None:
        for plane, scores in enumerate(sweep.of_rows(first, end, offset) for offset in offsets):
            costs[first:end, :, plane] = cost_of(scores)

    with workers(height * width * len(offsets) // 8) as pool:
        in_bands(pool, height, _LEAST_BAND, fill)
    return costs


def cost_of(score: Float32[np.ndarray, "rows width"]) -> UInt8[np.ndarray, "rows width"]:
    return (WORST_COST * (1.0 - np.clip(score, 0.0, 1.0)) + 0.5).astype(np.uint8)


def window_statistics(structure: Plane, radius_px: int) -> tuple[Plane, Plane]:
    """(mean, variance) in the windows around each pixel; at the border windows are cut off."""
    size = (2 * radius_px + 1, 2 * radius_px + 1)
    ones = cv2.boxFilter(np.ones_like(structure), cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    sums = [
        cv2.boxFilter(each, cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT) / ones for each in (structure, structure**2)
    ]
    return sums[0].astype(np.float32), np.maximum(sums[1] - sums[0] ** 2, 0.0).astype(np.float32)


class PlaneScores:
    """Scores of one plane after another (or of shells around base_dioptre): what stays the same is worked out once."""

    def __init__(self, reference: SweepView, neighbours: Sequence[SweepView], matching: Matching, base_dioptre: Plane) -> None:
        if not neighbours:
            raise InputError("a plane sweep needs at least one neighbouring view, got none: photograph from more places")
        self._structure, self._base, self._matching = np.ascontiguousarray(reference.structure), base_dioptre, matching
        self._rays = rays_of(reference)
        self._mean, self._variance = window_statistics(reference.structure, matching.radius_px)
        self._pictures = [np.ascontiguousarray(each.structure) for each in neighbours]
        self._views = [packed_view(reference, each) for each in neighbours]

    def of_rows(self, first: int, end: int, offset: float) -> Float32[np.ndarray, "rows width"]:
        """Mean correlation with the best neighbours of rows first <= y < end; `UNSEEN` where none sees the point."""
        from capture.dense._plane_sweep_numba import mean_of_best, score_neighbour

        matching = self._matching
        each = np.empty((len(self._views), end - first, self._structure.shape[1]), np.float32)
        fixed = (self._structure, self._mean, self._variance, self._rays, self._base, float(offset))
        for scores, picture, view in zip(each, self._pictures, self._views, strict=True):
            score_neighbour(*fixed, picture, view, (first, end), matching.radius_px, matching.noise**2, scores)
        best = np.empty(each.shape[1:], np.float32)
        mean_of_best(each, matching.best_of(len(self._views)), best)
        return best
