"""Soft or bright rims: how light within the discs changes from the middle to the rim."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.lens_measuring.matching.contours import inside
from mrbokeh.lens_measuring.matching.discs import Disc

_INSET_PX, _INSET = 1.2, 0.1  # the edge itself, spread over pixels
_FEWEST_PIXELS = 30


def rim_light(
    grey: Float32[np.ndarray, "height width"], discs: Sequence[Disc], own: Float64[np.ndarray, "discs 3"], side: int
) -> tuple[float, float] | None:
    """(spherical_aberration, its standard error) from discs that are not full; None where fewer than 2 are fit for it.

    Light within a disc, less that around it, is a (1 + s (2 rho^2 - 1)), rho in pupil radii and s the aberration times
    `side`; a and a s by least squares.
    """
    found = [_of_disc(grey, disc, place) for disc, place in zip(discs, own, strict=True) if not disc.full]
    values = np.array([each for each in found if each is not None])
    if len(values) < 2:
        return None
    draws = np.random.default_rng(0).choice(values, (400, len(values)))
    spread = max(float(np.median(draws, axis=1).std()), float(values.std()) / np.sqrt(len(values)))
    return float(np.clip(side * np.median(values), -1.0, 1.0)), spread


def _of_disc(grey: Float32[np.ndarray, "height width"], disc: Disc, own: Float64[np.ndarray, "3"]) -> float | None:
    low = np.maximum(np.floor(disc.contour_px.min(axis=0)).astype(int), 0)
    high = np.ceil(disc.contour_px.max(axis=0)).astype(int) + 1
    crop = grey[low[1] : high[1], low[0] : high[0]].astype(np.float64)
    within = inside(crop.shape, disc.contour_px - low, max(_INSET_PX, _INSET * disc.radius_px))
    if within.sum() < _FEWEST_PIXELS:
        return None
    rows, columns = np.indices(crop.shape) + 0.5
    apart = ((columns + low[0] - own[0]) ** 2 + (rows + low[1] - own[1]) ** 2)[within] / own[2] ** 2
    basis = np.stack([np.ones_like(apart), 2.0 * apart - 1.0], axis=1)
    (mean, slope), *_ = np.linalg.lstsq(basis, crop[within] - disc.around, rcond=None)
    return float(slope / mean) if mean > 0.0 else None
