"""The bins of the gated form in groups that are computed together, each at a resolution of its own."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from training.fast_export.coarse_kernels import coarse_kernel, taps_radius
from training.fast_export.gated_weights import GatedWeights, widened
from training.gated_bins import blocks_for_gates

_PASSES, _COARSE_PASSES = 250.0, 100.0  # measured on Zen 5, in multiplications of a convolution channel by channel


@dataclass(frozen=True)
class Group:
    """Bins first to end, in order. factor: 1, 2 or 4, by which their resolution is lowered.

    kernels: (bins * bases * maps, 1, k, k), for Conv. span_px: the signed diameters between which a pixel belongs to one of these bins.
    """

    first: int
    end: int
    factor: int
    kernels: np.ndarray
    span_px: tuple[float, float]

    @property
    def count(self) -> int:
        return self.end - self.first


def groups_of(weights: GatedWeights, factors: Sequence[int]) -> list[Group]:
    """factors: for n = 1, 2, ... A group is as fine as its smallest kernel asks."""
    return [_group(weights, bins, factor) for bins, factor in shared(weights, factors)]


def cost(weights: GatedWeights, factors: Sequence[int]) -> float:
    """Multiplications per pixel, with passes over a map counted as what takes as long."""
    total = 0.0
    for bins, factor in shared(weights, factors):
        radius = max(weights.radii_px[each] for each in bins)
        taps = radius if factor == 1 else taps_radius(radius, factor)
        total += len(bins) * (_PASSES + (_COARSE_PASSES if factor > 1 else 0.0) + ((2 * taps + 1) / factor) ** 2)
    return total * weights.maps * weights.bases


def reach_px(weights: GatedWeights, factors: Sequence[int]) -> int:
    """How far from a pixel the graph looks."""
    radii = [(max(weights.radii_px[each] for each in bins), factor) for bins, factor in shared(weights, factors)]
    return max(radius if factor == 1 else factor * (taps_radius(radius, factor) + 1) for radius, factor in radii)


def shared(weights: GatedWeights, factors: Sequence[int]) -> list[tuple[range, int]]:
    """Which bins share a group, and its factor. What does not fill a group is left around the focus."""
    at_once, count = weights.bins_at_once, len(weights.knots_px)
    centre = int(np.argmin(np.abs(weights.knots_px)))
    near, far = centre // at_once * at_once, count - (count - 1 - centre) // at_once * at_once
    starts = [*range(0, near, at_once), near, *range(far, count, at_once)]
    together = [range(*ends) for ends in zip(starts, [*starts[1:], count], strict=True)]
    return [(bins, min(factors[min(blocks_for_gates(weights.knots_px[each]), len(factors)) - 1] for each in bins)) for bins in together]


def _group(weights: GatedWeights, bins: range, factor: int) -> Group:
    kernels = [_at_resolution(weights.kernels[each], factor) for each in bins]
    largest = max(each.shape[-1] for each in kernels)
    stacked = np.stack([widened(each, largest) for each in kernels])  # (bins, bases, colours, k, k)
    repeats = 2 if weights.colours == 3 else 4
    maps = np.tile(stacked, (1, 1, repeats, 1, 1)).reshape(-1, 1, largest, largest).astype(np.float32)
    return Group(bins.start, bins.stop, factor, maps, _span_px(weights.knots_px, bins))


def _at_resolution(kernels: np.ndarray, factor: int) -> np.ndarray:
    if factor == 1:
        return kernels
    return np.stack([np.stack([coarse_kernel(kernel, factor) for kernel in base]) for base in kernels])


def _span_px(knots_px: Sequence[float] | np.ndarray, bins: range) -> tuple[float, float]:
    """The knots beside these bins, outermost ones open."""
    low = float(knots_px[bins.start - 1]) if bins.start else -math.inf
    return low, float(knots_px[bins.stop]) if bins.stop < len(knots_px) else math.inf
