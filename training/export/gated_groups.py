"""Groups of the gated form's bins that are computed together, each at its own resolution and in a window of the picture.

A window encloses the pixels of a group and the reach of their light; nothing is computed outside.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from training.export.gated_weights import GatedWeights, widened
from training.export.graph_builder import GraphBuilder, coarse_kernel, taps_radius
from training.networks.gated_network import blocks_for_gates

_PASSES, _COARSE_PASSES = 250.0, 100.0  # measured on Zen 5, in multiplications of a convolution channel by channel


@dataclass(frozen=True)
class Group:
    """Bins first to end, in order. factor: 1, 2 or 4, the reduction of their resolution.

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
    """Group the bins; a group is as fine as its smallest kernel needs. factors: for n = 1, 2, ..."""
    return [_group(weights, bins, factor) for bins, factor in shared(weights, factors)]


def cost(weights: GatedWeights, factors: Sequence[int]) -> float:
    """Return multiplications per pixel, counting passes over a map by their time."""
    total = 0.0
    for bins, factor in shared(weights, factors):
        radius = max(weights.radii_px[each] for each in bins)
        taps = radius if factor == 1 else taps_radius(radius, factor)
        total += len(bins) * (_PASSES + (_COARSE_PASSES if factor > 1 else 0.0) + ((2 * taps + 1) / factor) ** 2)
    return total * weights.maps * weights.bases


def reach_px(weights: GatedWeights, factors: Sequence[int]) -> int:
    """Return how far from a pixel the graph looks."""
    radii = [(max(weights.radii_px[each] for each in bins), factor) for bins, factor in shared(weights, factors)]
    return max(radius if factor == 1 else factor * (taps_radius(radius, factor) + 1) for radius, factor in radii)


def shared(weights: GatedWeights, factors: Sequence[int]) -> list[tuple[range, int]]:
    """Return the bins of each group, and its factor; an incomplete group is left around the focus."""
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
    return Group(first=bins.start, end=bins.stop, factor=factor, kernels=maps, span_px=_span_px(weights.knots_px, bins))


def _at_resolution(kernels: np.ndarray, factor: int) -> np.ndarray:
    if factor == 1:
        return kernels
    return np.stack([np.stack([coarse_kernel(kernel, factor) for kernel in base]) for base in kernels])


def _span_px(knots_px: Sequence[float] | np.ndarray, bins: range) -> tuple[float, float]:
    """Return the knots beside these bins, outermost ones open."""
    low = float(knots_px[bins.start - 1]) if bins.start else -math.inf
    return low, float(knots_px[bins.stop]) if bins.stop < len(knots_px) else math.inf


@dataclass(frozen=True)
class Window:
    """The rectangle reached by a group's pixels, and whether there are any: values of the graph, of shape () and (2,).

    starts and ends: row and column, multiples of `step`, the coarsest factor of all groups; size: of the whole picture.
    """

    used: str
    starts: str
    ends: str
    size: str

    def cut(self, graph: GraphBuilder, planes: str, axes: Sequence[int] = (2, 3)) -> str:
        """Return the part of planes inside."""
        return graph.op("Slice", planes, self.starts, self.ends, graph.ints(list(axes)))

    def placed(self, graph: GraphBuilder, planes: str) -> str:
        """Pad planes (B, C, h, w) of the window with zeros to the whole picture."""
        none = graph.ints([0, 0])
        return graph.op("Pad", planes, graph.op("Concat", none, self.starts, none, graph.op("Sub", self.size, self.ends), axis=0))


def windows_of(graph: GraphBuilder, groups: Sequence[Group], position: str, size: Sequence[str], step: int) -> list[Window]:
    """Add the windows. position: (B, 1, H, W), signed diameters; size: H and W, multiples of step."""
    whole = graph.op("Concat", *size, axis=0)
    return [_window(graph, group, position, whole, step) for group in groups]


def _window(graph: GraphBuilder, group: Group, position: str, size: str, step: int) -> Window:
    low, high = (graph.floats(np.clip(each, -1e9, 1e9)) for each in group.span_px)
    inside = graph.op("Cast", graph.op("And", graph.op("Greater", position, low), graph.op("Less", position, high)), to=1)
    rows = graph.op("ReduceMax", inside, graph.ints([0, 1, 3]), keepdims=0)
    columns = graph.op("ReduceMax", inside, graph.ints([0, 1, 2]), keepdims=0)
    used = graph.op("Greater", graph.op("ReduceMax", rows, keepdims=0), graph.floats(0.5))
    first = graph.op("Concat", *(graph.op("ArgMax", each, axis=0) for each in (rows, columns)), axis=0)
    last = graph.op("Concat", *(graph.op("ArgMax", each, axis=0, select_last_index=1) for each in (rows, columns)), axis=0)
    reach, steps = graph.ints([reach_of(group, step)]), graph.ints([step])
    starts = graph.op("Sub", graph.op("Div", first, steps), reach)
    ends = graph.op("Add", graph.op("Div", last, steps), graph.op("Add", reach, graph.ints([1])))
    from_edge = graph.op("Mul", graph.op("Max", starts, graph.ints([0, 0])), steps)
    return Window(used, from_edge, graph.op("Min", graph.op("Mul", ends, steps), size), size)


def reach_of(group: Group, step: int) -> int:
    """Return the reach of a group's light in steps, with the cells of gathering and interpolation."""
    taps = group.kernels.shape[-1] // 2
    return -(-group.factor * (taps + (2 if group.factor > 1 else 0)) // step)
