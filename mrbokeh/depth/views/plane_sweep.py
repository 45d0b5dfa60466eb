"""Plane sweep in dioptres: the agreement of neighbouring views with the reference if its points lay on each of many planes.

Collins 1996 (A space-sweep approach to true multi-image matching), with zero-mean normalised cross-correlation in windows and
the mean of the best few neighbours (Kang, Szeliski and Chai 2001), so that a view in which a point is hidden does not count.
Planes are equally spaced in dioptres: so are their pictures in a neighbour, and so is blur. Their step moves the picture of the
widest neighbour by a given number of pixels.

A second, fine sweep around a surface slants the windows with it, so that steep surfaces match as sharply as frontal ones.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, UInt8

from mrbokeh.depth.views.sweep_view import Plane, SweepView, neighbour_from_reference, packed_view, rays_of
from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import in_bands, workers

Costs = UInt8[np.ndarray, "height width planes"]

WORST_COST = 255
UNSEEN = -2.0
"""Score of a point that no neighbour sees."""
_LEAST_BAND = 32
LEAST_PARALLAX_PX = 8.0
_PROBES = 5
_LEAST_CURVATURE = 1e-4


@dataclass(frozen=True)
class Matching:
    """Comparison of windows.

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
    """Return the (H, W, D) cost of each plane, 255 (1 - correlation) in 0..255: 0 agrees, 255 is uncorrelated or worse.

    offsets: the dioptres of the planes; with base_dioptre (H, W) they are added to it, which sweeps a shell around a surface and
      so compares slanted windows where the surface slants.
    The cost is 255 where no neighbour sees a point. Memory: 1 byte per cell and a band of rows of float32 scores.
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
    """Return (mean, variance) in the windows around each pixel; windows are cut off at the border."""
    size = (2 * radius_px + 1, 2 * radius_px + 1)
    ones = cv2.boxFilter(np.ones_like(structure), cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT)
    sums = [
        cv2.boxFilter(each, cv2.CV_64F, size, normalize=False, borderType=cv2.BORDER_CONSTANT) / ones for each in (structure, structure**2)
    ]
    return sums[0].astype(np.float32), np.maximum(sums[1] - sums[0] ** 2, 0.0).astype(np.float32)


class PlaneScores:
    """Scores of one plane after another (or of shells around base_dioptre), with everything they share computed once."""

    def __init__(self, reference: SweepView, neighbours: Sequence[SweepView], matching: Matching, base_dioptre: Plane) -> None:
        if not neighbours:
            raise InputError("a plane sweep needs at least one neighbouring view, got none: photograph from more places")
        self._structure, self._base, self._matching = np.ascontiguousarray(reference.structure), base_dioptre, matching
        self._rays = rays_of(reference)
        self._mean, self._variance = window_statistics(reference.structure, matching.radius_px)
        self._pictures = [np.ascontiguousarray(each.structure) for each in neighbours]
        self._views = [packed_view(reference, each) for each in neighbours]

    def of_rows(self, first: int, end: int, offset: float) -> Float32[np.ndarray, "rows width"]:
        """Return the mean correlation with the best neighbours of rows first <= y < end; `UNSEEN` where none sees the point."""
        from mrbokeh.depth.views._views_numba import Reference, mean_of_best, score_neighbour

        matching = self._matching
        each = np.empty((len(self._views), end - first, self._structure.shape[1]), np.float32)
        reference = Reference(picture=self._structure, mean=self._mean, variance=self._variance, rays=self._rays, dioptres=self._base)
        for scores, picture, view in zip(each, self._pictures, self._views, strict=True):
            score_neighbour(reference, float(offset), picture, view, (first, end), matching.radius_px, matching.noise**2, scores)
        best = np.empty(each.shape[1:], np.float32)
        mean_of_best(each, matching.best_of(len(self._views)), best)
        return best


def pixels_per_dioptre(reference: SweepView, neighbour: SweepView, nearest_dioptre: float, farthest_dioptre: float) -> float:
    """Return the largest shift of a point in the neighbour's picture per dioptre (0 for a neighbour at the same place)."""
    camera = reference.camera
    x, y = np.meshgrid(np.linspace(0.0, camera.width_px, _PROBES), np.linspace(0.0, camera.height_px, _PROBES))
    plane = (np.stack([x, y], axis=-1) - camera.principal_px) / np.asarray(camera.focal_px)
    rays = np.concatenate([plane, np.ones_like(plane[..., :1])], axis=-1)
    pose = neighbour_from_reference(camera, neighbour.camera)
    rotated = rays @ pose[:3, :3].T
    fastest = 0.0
    for dioptre in np.linspace(farthest_dioptre, nearest_dioptre, _PROBES):
        x_y_z = rotated + dioptre * pose[:3, 3]
        before = x_y_z[..., 2] > 1e-3
        if before.any():
            moves = (pose[:2, 3] * x_y_z[..., 2:] - x_y_z[..., :2] * pose[2, 3]) / x_y_z[..., 2:] ** 2
            fastest = max(fastest, float(np.linalg.norm(moves * neighbour.camera.focal_px, axis=-1)[before].max()))
    return fastest


def dioptre_planes(
    reference: SweepView, neighbours: Sequence[SweepView], dioptre_range: tuple[float, float], step_px: float = 0.5, most: int = 0
) -> Float[np.ndarray, " planes"]:
    """Return dioptres from far to near (ascending) in steps of at most `step_px` in the widest neighbour; `most` > 0 caps their number.

    dioptre_range: (farthest, nearest), 1 / metres. Raises InputError if no neighbour stands apart from the reference.
    """
    farthest, nearest = dioptre_range
    if not 0.0 <= farthest < nearest:
        raise InputError(f"a plane sweep needs a range of depths from far to near, got {farthest:g} to {nearest:g} dioptres")
    rates = [pixels_per_dioptre(reference, each, nearest, farthest) for each in neighbours]
    travel_px = max(rates, default=0.0) * (nearest - farthest)
    if travel_px < 1.0:
        raise InputError(
            f"no neighbouring view shows parallax (the largest shift is {travel_px:.2f} px over the range of depths): "
            f"photograph from places that lie apart, or keep the depth from focus"
        )
    count = int(np.ceil(travel_px / step_px)) + 1
    return np.linspace(farthest, nearest, min(count, most) if most else count)


def by_parallax(reference: SweepView, neighbours: Sequence[SweepView], dioptre_range: tuple[float, float]) -> list[SweepView]:
    """Sort neighbours by parallax, least first, since their planes are densest; those with too little to tell depth come last."""
    farthest, nearest = dioptre_range

    def place(neighbour: SweepView) -> tuple[bool, float]:
        travel_px = pixels_per_dioptre(reference, neighbour, nearest, farthest) * (nearest - farthest)
        return travel_px < LEAST_PARALLAX_PX, travel_px

    return sorted(neighbours, key=place)


@dataclass(frozen=True)
class Refined:
    """A refined surface.

    dioptre (H, W). score: correlation there, -1..1 (-2 where no neighbour sees the point). curvature: drop of the score within a step,
    0 if the best is at the end of the shell; there the dioptre is left as it was.
    """

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
    """Choose the best of 2 reach + 1 surfaces, step_dioptre apart, around base_dioptre, and interpolate by a parabola."""
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
    """Return (fractional index of the peak, its score, its curvature); the middle index and curvature 0 if the peak is at an end."""
    best = scores.argmax(axis=0)
    middle, inside = len(scores) // 2, (best > 0) & (best < len(scores) - 1)
    at = np.where(inside, best, middle)
    before, here, after = (np.take_along_axis(scores, (at + k)[None], axis=0)[0] for k in (-1, 0, 1))
    curvature = np.where(inside, 2.0 * here - before - after, 0.0)
    offset = np.where(curvature > _LEAST_CURVATURE, 0.5 * (after - before) / np.maximum(curvature, _LEAST_CURVATURE), 0.0)
    return (at + np.clip(offset, -0.5, 0.5)).astype(np.float32), here, np.maximum(curvature, 0.0).astype(np.float32)
