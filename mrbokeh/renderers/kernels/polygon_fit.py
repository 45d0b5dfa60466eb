"""A measured kernel as weighted polygons: its iso-contours in the unit pupil, weighted so that they add up to it."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.aperture_shapes import WeightedOutlines, net_area, outlines_of
from mrbokeh.system.errors import InputError

LEVELS = 4
_SPECK_PX2 = 0.5
_ISLANDS = (0.02, 0.05)  # of the area of the circle of confusion: smaller ones may be left out
_STRAY_PX = 0.05
_SUM_TO_ONE = 10.0
_LEAST_WEIGHT = 0.005
_FEWER_LEVELS, _NO_ISLANDS = 1.1, 4.0 / 3.0


class PolygonFit(NamedTuple):
    """aperture: as seen behind the focus. relative_error: what it misses of the kernel, norm over norm."""

    aperture: Aperture
    relative_error: float


def fit_polygons(kernel: Float[np.ndarray, "size size"], diameter_px: float, levels: int = LEVELS) -> PolygonFit:
    """A kernel of a point behind the focus with this circle of confusion (above 0) as a sum of polygons.

    The candidates are the kernel's contours at `levels` heights; their weights are those, none negative, that come nearest to it
    in the sense of squares when drawn at this diameter, and give its sum. Renderers pay for every outline, so half as many levels are
    taken where they miss at most 10 % more, and small islands, which are the noise of a measurement, are left out where that misses
    at most a third more. Raises InputError where a kernel has no inside.
    """
    if not diameter_px > 2.0 or levels < 1:
        raise InputError(f"polygons are fitted to kernels of more than 2 px in 1 or more levels, got {diameter_px} px and {levels}")
    wanted = kernel.astype(np.float64) / kernel.sum(dtype=np.float64)
    fits = {count: fit for count in _counts(levels) if (fit := _fit(wanted, diameter_px, count, _SPECK_PX2)) is not None}
    if not fits:
        raise InputError(f"this kernel of {len(kernel)} px has no inside to draw polygons around: take --method laplacian, or more blur")
    best = min(fit.relative_error for fit in fits.values())
    count = next(each for each, fit in fits.items() if fit.relative_error <= _FEWER_LEVELS * best)
    cleaned = [_fit(wanted, diameter_px, count, share * 0.25 * np.pi * diameter_px**2) for share in _ISLANDS]
    good = [fit for fit in cleaned if fit is not None and fit.relative_error <= _NO_ISLANDS * best]
    return min([fits[count], *good], key=lambda fit: len(fit.aperture.outlines))


def _counts(levels: int) -> list[int]:
    """As many as there may be, and halves of that."""
    return sorted({max(1, levels >> i) for i in range(levels.bit_length())})


def _fit(wanted: Float64[np.ndarray, "size size"], diameter_px: float, levels: int, least_px2: float) -> PolygonFit | None:
    """With contours around areas larger than this; None where there are none."""
    heights = (np.arange(levels) + 0.5) / levels
    candidates = [each for height in heights if (each := _contour(wanted, float(height), 0.5 * diameter_px, least_px2)) is not None]
    if not candidates:
        return None
    weights = _weights([_drawn(each, diameter_px) for each in candidates], wanted)
    kept = [(each, weight) for each, weight in zip(candidates, weights, strict=True) if weight > _LEAST_WEIGHT]
    outlines = tuple(outline for each, _ in kept for outline in each[0])
    aperture = Aperture(outlines, tuple(weight * share / net_area(each) for each, weight in kept for share in each[1]))
    return PolygonFit(aperture, relative_error(aperture.rasterize(diameter_px).kernel, wanted))


def relative_error(found: Float[np.ndarray, "rows rows"], wanted: Float[np.ndarray, "size size"]) -> float:
    """Norm of the difference of two centred kernels over that of the one wanted."""
    size = max(len(found), len(wanted))
    return float(np.linalg.norm(grown(found, size) - grown(wanted, size)) / np.linalg.norm(wanted))


def grown(kernel: Float64[np.ndarray, "rows rows"], size: int) -> Float64[np.ndarray, "size size"]:
    """A kernel with a border of zeros, so that it is `size` wide; both odd."""
    return np.pad(kernel, (size - len(kernel)) // 2)


def _contour(kernel: Float64[np.ndarray, "size size"], height: float, radius_px: float, least_px2: float) -> WeightedOutlines | None:
    """Where a kernel is brighter than this share of its brightest pixel, in the unit pupil; None where that is nothing."""
    from contourpy import FillType, contour_generator
    from shapely import MultiPolygon, Polygon, make_valid

    padded = np.pad(kernel / kernel.max(), 1)
    middle = 0.5 * (len(padded) - 1)
    tracer: Any = contour_generator(z=padded, fill_type=FillType.OuterOffset)
    areas = []
    for points, starts in zip(*tracer.filled(height, 2.0), strict=True):
        rings = [points[start:stop] - middle for start, stop in pairwise(starts)]
        areas.append(Polygon(rings[0], rings[1:]))
    large = [part for part in areas if part.area > least_px2]
    found = outlines_of(make_valid(MultiPolygon(large)).simplify(_STRAY_PX))
    return (tuple(outline / radius_px for outline in found[0]), found[1]) if found[0] else None


def _drawn(opening: WeightedOutlines, diameter_px: float) -> Float64[np.ndarray, "size size"]:
    return Aperture(*opening).rasterize(diameter_px).kernel


def _weights(drawn: Sequence[np.ndarray], wanted: Float64[np.ndarray, "size size"]) -> Float64[np.ndarray, " candidates"]:
    """Of candidates that sum to 1 each; they sum to 1."""
    from scipy.optimize import nnls

    size = max(len(each) for each in (*drawn, wanted))
    columns = np.stack([grown(each, size).ravel() for each in drawn], axis=1)
    firmly = _SUM_TO_ONE * np.linalg.norm(wanted)
    found, _ = nnls(np.vstack([columns, np.full((1, len(drawn)), firmly)]), np.append(grown(wanted, size).ravel(), firmly))
    return np.asarray(found / found.sum())
