"""How many blades: openings of 5 to 11 against a round one by the evidence of the contours, without the spots that are no discs."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from mrbokeh.lens_measuring.matching.discs import Disc
from mrbokeh.lens_measuring.matching.outline_equations import names_of
from mrbokeh.lens_measuring.matching.outline_fit import OutlineFit, fit_outlines
from mrbokeh.lens_measuring.matching.outline_model import Opening

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
    """found: how many discs there were; discs: those that agree. log_evidence: of each number of blades over a round opening, natural
    logarithm (half the difference of Schwarz's BIC).
    """

    found: int
    discs: tuple[Disc, ...]
    fit: OutlineFit
    log_evidence: dict[int, float]

    @property
    def is_poor(self) -> bool:
        """Whether the discs look like none of the openings that were tried, or few of those found do."""
        few = len(self.discs) < min(_LEAST_SHARE * self.found, ENOUGH_DISCS)
        return few or float(np.median(self.fit.relative_rms)) > max(_POOR, _POOR_PX / float(np.median(self.fit.own[:, 2])))


def choose_opening(discs: Sequence[Disc], side: int) -> BladeChoice:
    """The best opening; discs that it fits much worse than the others are left out and the rest is fitted again."""
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
    rounds = [fit_outlines(discs, Opening(0, cat_eye=sign * _START_CAT_EYE), side) for sign in (1.0, -1.0)]
    best_round = max(rounds, key=lambda fit: fit.log_likelihood)
    fits = {count: _bladed(discs, best_round, count, side) for count in BLADES}
    evidence = {count: _log_evidence(fit) - _log_evidence(best_round) for count, fit in fits.items()}
    count = max(evidence, key=lambda each: evidence[each])
    seen = evidence[count] > _LEAST_EVIDENCE and _departure_px(fits[count]) > _LEAST_DEPARTURE_PX
    return BladeChoice(len(discs), tuple(discs), fits[count] if seen else best_round, evidence)


def _bladed(discs: list[Disc], around: OutlineFit, count: int, side: int) -> OutlineFit:
    """Started from the round fit, with corners where its residuals have those of that many corners."""
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
    """How far the middle of a blade lies within the circle through the corners."""
    half, curvature = np.pi / fit.opening.blades, fit.opening.curvature
    bow = 0.5 * curvature * np.sin(half) ** 2  # of a shallow arc
    return float(np.median(fit.own[:, 2]) * max(1.0 - np.cos(half) - bow, 0.0))
