"""Openings from discs: how many blades there are, the mean outline of discs that have none, and soft or bright rims.

Openings of 5 to 11 blades compete with a round one by the evidence of the contours, without the spots that are no discs. Discs that look
like none of them (a drawn, cut-out or dirty opening) are described by their mean outline.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.lens_measuring.matching.discs import Disc, inside
from mrbokeh.lens_measuring.matching.outline_fit import BladedOpening, OutlineFit, fit_outlines, names_of
from mrbokeh.optics.aperture import Aperture

BLADES = range(5, 12)
FEWEST_DISCS = 3
ENOUGH_DISCS, _LEAST_SHARE = 8, 0.4
_LEAST_EVIDENCE = 5.0  # natural logarithm of a ratio of 150: strong by Kass and Raftery, Bayes factors, 1995
_LEAST_DEPARTURE_PX = 0.15  # from a circle; the grid of pixels alone imitates half of it with 8 blades
_ODD_TIMES, _ODD_LEAST, _ODD_LEAST_PX = 2.5, 0.03, 0.35
_POOR, _POOR_PX = 0.035, 0.3
_START_CAT_EYE, _START_CURVATURE = 0.3, 0.4
_ROUNDS = 4


@dataclass(frozen=True)
class BladeChoice:
    """BladedOpening that explains the discs best.

    found: how many discs there were; discs: those that agree. log_evidence: of each number of blades over a round opening, natural
    logarithm (half the difference of Schwarz's BIC).
    """

    found: int
    discs: tuple[Disc, ...]
    fit: OutlineFit
    log_evidence: dict[int, float]

    @property
    def is_poor(self) -> bool:
        """Return whether the discs look like none of the openings that were tried, or few of those found do."""
        few = len(self.discs) < min(_LEAST_SHARE * self.found, ENOUGH_DISCS)
        return few or float(np.median(self.fit.relative_rms)) > max(_POOR, _POOR_PX / float(np.median(self.fit.own[:, 2])))


def choose_opening(discs: Sequence[Disc], side: int) -> BladeChoice:
    """Return the best opening; discs that it fits much worse than the others are left out and the rest is fitted again."""
    kept = list(discs)
    for _ in range(_ROUNDS):
        choice = _choose(kept, side)
        errors, radii = choice.fit.relative_rms, choice.fit.own[:, 2]
        good = errors <= np.maximum(np.maximum(_ODD_LEAST, _ODD_LEAST_PX / radii), _ODD_TIMES * np.median(errors))
        if good.all() or good.sum() < FEWEST_DISCS:
            break
        kept = [disc for disc, is_good in zip(kept, good, strict=True) if is_good]
    return replace(choice, found=len(discs))


def _choose(discs: list[Disc], side: int) -> BladeChoice:
    rounds = [fit_outlines(discs, BladedOpening(0, cat_eye=sign * _START_CAT_EYE), side) for sign in (1.0, -1.0)]
    best_round = max(rounds, key=lambda fit: fit.log_likelihood)
    fits = {count: _bladed(discs, best_round, count, side) for count in BLADES}
    evidence = {count: _log_evidence(fit) - _log_evidence(best_round) for count, fit in fits.items()}
    count = max(evidence, key=lambda each: evidence[each])
    seen = evidence[count] > _LEAST_EVIDENCE and _departure_px(fits[count]) > _LEAST_DEPARTURE_PX
    return BladeChoice(len(discs), tuple(discs), fits[count] if seen else best_round, evidence)


def _bladed(discs: list[Disc], around: OutlineFit, count: int, side: int) -> OutlineFit:
    """Fit from the round opening, with corners where its residuals have those of that many corners."""
    contours = np.stack([disc.contour_px for disc in discs])
    away = (contours - around.own[:, None, :2]) * side
    angles = np.arctan2(away[..., 1], around.opening.squeeze * away[..., 0])
    share = np.clip(around.residuals_px / around.own[:, 2:], -0.2, 0.2)
    rotation_rad = float(np.angle((share * np.exp(1j * count * angles)).sum())) / count
    start = replace(around.opening, blades=count, rotation_rad=rotation_rad, curvature=_START_CURVATURE)
    return fit_outlines(discs, start, side, around.own)


def _log_evidence(fit: OutlineFit) -> float:
    return fit.log_likelihood - 0.5 * len(names_of(fit.opening)) * float(np.log(fit.samples))


def _departure_px(fit: OutlineFit) -> float:
    """Return how far the middle of a blade lies within the circle through the corners."""
    half, curvature = np.pi / fit.opening.blades, fit.opening.curvature
    bow = 0.5 * curvature * np.sin(half) ** 2  # of a shallow arc
    return float(np.median(fit.own[:, 2]) * max(1.0 - np.cos(half) - bow, 0.0))


ANGLES = 96
_ALIKE, _ALIKE_PX = 0.05, 0.2
_LEAST_ALIKE = 0.4


@dataclass(frozen=True)
class MeanOutline:
    """Mean outline of discs that look alike.

    aperture: in the unit pupil. radius_px: of that unit in each disc. disagreement: of the discs with the mean, share of the radius.
    """

    discs: tuple[Disc, ...]
    aperture: Aperture
    radius_px: Float64[np.ndarray, " discs"]
    disagreement: float


def mean_outline(discs: Sequence[Disc], side: int) -> MeanOutline | None:
    """Return the mean of the largest group of discs that look alike; None if too few or too small a share of them do."""
    shapes = np.stack([_radius_over_angle(disc, side) for disc in discs])
    sizes = np.array([disc.radius_px for disc in discs])
    limit = np.maximum(_ALIKE, _ALIKE_PX / sizes)
    apart = np.sqrt(((shapes[:, None] - shapes[None]) ** 2).mean(axis=2))
    middle = int((apart < 2.0 * limit).sum(axis=1).argmax())
    mean = np.median(shapes[apart[middle] < 2.0 * limit], axis=0)
    away = np.sqrt(((shapes - mean) ** 2).mean(axis=1))
    alike = away < limit
    if alike.sum() < max(FEWEST_DISCS, _LEAST_ALIKE * len(discs)):
        return None
    mean = np.average(shapes[alike], axis=0, weights=sizes[alike] ** 2)
    angles = 2.0 * np.pi * np.arange(ANGLES) / ANGLES
    points = mean[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    kept = tuple(disc for disc, is_alike in zip(discs, alike, strict=True) if is_alike)
    return MeanOutline(kept, Aperture.from_outline(points), sizes[alike] * float(mean.max()), float(np.median(away[alike])))


def _radius_over_angle(disc: Disc, side: int) -> Float64[np.ndarray, " angles"]:
    """Return the radius about the centroid, in radii of the disc of the same area; the farthest crossing if a direction has several."""
    away = side * (disc.contour_px - disc.centroid_px) / disc.radius_px
    angles, radius = np.arctan2(away[:, 1], away[:, 0]), np.hypot(away[:, 0], away[:, 1])
    order = np.argsort(angles)
    return np.interp(2.0 * np.pi * np.arange(ANGLES) / ANGLES, angles[order], radius[order], period=2.0 * np.pi)


_INSET_PX, _INSET = 1.2, 0.1  # the edge itself, spread over pixels
_FEWEST_PIXELS = 30


def rim_light(
    grey: Float32[np.ndarray, "height width"], discs: Sequence[Disc], own: Float64[np.ndarray, "discs 3"], side: int
) -> tuple[float, float] | None:
    """Return (spherical_aberration, its standard error) from discs that are not full; None if fewer than 2 are fit for it.

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
