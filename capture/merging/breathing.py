"""Focus breathing: how much larger each slice shows the scene than the first one does."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

# How far the scale between two slices may be from the model, whatever pictures say (strongly defocused ones say much).
LARGEST_DEPARTURE = 0.01
_ROUNDS = 30
_SMALLEST_SCATTER = 2e-4
_FEWEST_FOR_A_BEND = 5

Pair = tuple[int, int]


@dataclass(frozen=True)
class Breathing:
    """The model of a stack.

    scales: magnification of each slice; only ratios count.
    source: "lens" (image distances of the thin lens) or "pictures" (a smooth curve through what was measured).
    largest_departure: how far (relative) a measured scale may be from the model.
    """

    scales: tuple[float, ...]
    source: Literal["lens", "pictures"]
    largest_departure: float = LARGEST_DEPARTURE

    def scale(self, target: int, source: int) -> float:
        """Of target_from_source."""
        return self.scales[target] / self.scales[source]

    def allows(self, pair: Pair, measured_scale: float) -> bool:
        return bool(abs(measured_scale / self.scale(*pair) - 1.0) <= self.largest_departure)


def breathing_of(
    count: int, measured: Mapping[Pair, float], lens_scales: Sequence[float] | None, unknown: Collection[int] = ()
) -> Breathing:
    """The lens's own breathing where most pairs agree with it, else one smooth curve over the slices.

    measured: scale of target_from_source of pairs (target, source).
    lens_scales: image distances of the slices; None where the lens or its focus is unknown. Lenses with internal focusing
      breathe otherwise than the thin lens.
    unknown: slices whose scale is the lens's at infinity because nobody knows their focus; pictures tell it between there and the
      farthest known focus.
    """
    if lens_scales is not None:
        scales = _told_by_pictures(lens_scales, unknown, measured)
        lens = Breathing(tuple(float(scale / scales[0]) for scale in scales), "lens")
        known = {pair: scale for pair, scale in measured.items() if not set(pair) & set(unknown)}
        if not known or np.median([abs(scale / lens.scale(*pair) - 1.0) for pair, scale in known.items()]) <= LARGEST_DEPARTURE:
            return lens
    return _fitted(_abscissae(count, lens_scales), measured)


def _told_by_pictures(lens_scales: Sequence[float], unknown: Collection[int], measured: Mapping[Pair, float]) -> list[float]:
    """One after the other, by the median of the pairs with slices that are known or told before; where there are none, as given."""
    scales = {index: float(scale) for index, scale in enumerate(lens_scales) if index not in unknown}
    least_known = min(scales.values(), default=np.inf)
    for index in sorted(unknown):
        pairs = ((target, source, ratio) for (target, source), ratio in measured.items() if index in (target, source))
        found = [ratio * scales[s] if t == index else scales[t] / ratio for t, s, ratio in pairs if {t, s} - {index} <= scales.keys()]
        if found:
            scales[index] = float(np.clip(np.median(found), lens_scales[index], max(lens_scales[index], least_known)))
    return [scales.get(index, float(scale)) for index, scale in enumerate(lens_scales)]


def _abscissae(count: int, lens_scales: Sequence[float] | None) -> Float[np.ndarray, " slices"]:
    """From 0 to 1: focus in dioptres as far as it is known (the log of the image distance is nearly linear in them), else the index."""
    along = np.arange(count, dtype=np.float64) if lens_scales is None else np.log(np.asarray(lens_scales, np.float64))
    if not np.ptp(along) > 0:
        along = np.arange(count, dtype=np.float64)
    return (along - along[0]) / (along[-1] - along[0] or 1.0)


def _fitted(along: Float[np.ndarray, " slices"], measured: Mapping[Pair, float]) -> Breathing:
    """log scale = c_1 u + c_2 u^2 by least absolute differences (reweighted least squares)."""
    terms = np.column_stack([along**power for power in range(1, 2 + (len(along) >= _FEWEST_FOR_A_BEND))])
    if not measured:
        return Breathing((1.0,) * len(along), "pictures")
    rows = np.array([terms[target] - terms[source] for target, source in measured])
    wanted = np.log(list(measured.values()))
    weights, coefficients = np.ones(len(wanted)), np.zeros(terms.shape[1])
    for _ in range(_ROUNDS):
        root = np.sqrt(weights)
        coefficients = np.linalg.lstsq(rows * root[:, None], wanted * root, rcond=None)[0]
        weights = 1.0 / np.maximum(np.abs(rows @ coefficients - wanted), _SMALLEST_SCATTER)
    # Uneven steps of the focus ring scatter about the curve; they are no errors.
    scatter = 1.4826 * float(np.median(np.abs(rows @ coefficients - wanted)))
    scales = tuple(float(each) for each in np.exp(terms @ coefficients))
    return Breathing(scales, "pictures", max(LARGEST_DEPARTURE, 4.0 * scatter))
