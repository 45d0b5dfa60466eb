"""The gated form as a graph: light is gated at full resolution, spread at that of its group and weighed at full resolution again.

Groups to which no pixel belongs are skipped, others are computed where their light reaches. In terms of
training/networks/gated_network.py: a first round gives what every group spreads, then the pointwise network sees gates and coverages,
and a second round adds up weight times spread light.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from onnx import ModelProto, numpy_helper

from training.export.gated_groups import Group, Window, groups_of, windows_of
from training.export.gated_weights import GatedWeights, pointwise
from training.export.graph_builder import GraphBuilder, enlarged, gathered
from training.networks.gated_network import LOGIT_LIMIT, GatedTiles
from training.networks.network import BlurNetwork

_ONE = numpy_helper.from_array(np.ones(1, np.float32))
_GROUPS_AT_ONCE = 5


@dataclass(frozen=True)
class GatedInputs:
    """Names of values at full resolution, padded with zeros at the bottom and right so that the coarsest pixels are whole.

    light: (B, 1, maps, H, W), the colours and ones; ramps: (B, bins + 1, H, W), see `ramp_lines`; features: (B, features, H, W) of place
    and lens, or ""; position: (B, 1, H, W), the circle of confusion that gates look at; size: H and W; true_size: before padding.
    """

    light: str
    ramps: str
    features: str
    position: str
    size: list[str]
    true_size: list[str]


def graph_inputs(network: BlurNetwork) -> dict[str, list[int | str]]:
    """Return the shape of each input by name."""
    planes: dict[str, list[int | str]] = {"rgb": ["batch", 3, "height", "width"], "coc_px": ["batch", 1, "height", "width"]}
    if network.field_position:
        planes["place"] = ["batch", 2, "height", "width"]
    if network.lens_scale is not None:
        planes["lens"] = ["batch", 2]
    return planes


def prepared(graph: GraphBuilder, network: BlurNetwork, weights: GatedWeights, coarsest: int) -> GatedInputs:
    """Add the values that every part of the graph reads. coarsest: factor of all groups."""
    true_size = [graph.size("rgb", 2), graph.size("rgb", 3)]
    shape = graph.op("Concat", graph.size("coc_px", 0), graph.ints([weights.colours]), *true_size, axis=0)
    ones = graph.op("Expand", graph.floats(np.ones((1, weights.colours, 1, 1))), shape)
    limit = graph.floats(network.largest_coc_px)
    signed = "coc_px" if network.signed_coc else graph.op("Abs", "coc_px")
    true_position = graph.op("Clip", signed, graph.op("Neg", limit), limit)
    grow = _Grow(graph, true_size, coarsest)
    light, position = grow(graph.op("Concat", "rgb", ones, axis=1)), grow(true_position)
    whole = [graph.size(position, 2), graph.size(position, 3)]
    with_one = graph.op("Concat", position, graph.op("ConstantOfShape", graph.op("Shape", position), value=_ONE), axis=1)
    lines = times(graph, ramp_lines(weights.knots_px), with_one, whole)
    ramps = graph.op("Clip", lines, graph.floats(0.0), graph.floats(1.0))
    features = _features(graph, network, grow, whole)
    return GatedInputs(
        light=graph.op("Unsqueeze", light, graph.ints([1])),
        ramps=ramps,
        features=features,
        position=position,
        size=whole,
        true_size=true_size,
    )


def times(graph: GraphBuilder, weight: np.ndarray, planes: str, size: list[str]) -> str:
    """Multiply by weight (outputs, inputs) at every pixel, as a matrix product, since a Conv first reorders the planes."""
    flat = graph.op("Reshape", planes, graph.ints([0, weight.shape[1], -1]))
    product = graph.op("MatMul", graph.floats(weight), flat)
    return graph.op("Reshape", product, graph.op("Concat", graph.ints([0, len(weight)]), *size, axis=0))


def ramp_lines(knots_px: np.ndarray) -> np.ndarray:
    """Return (bins + 1, 2), slope and offset: lines that, clipped to [0, 1], rise between neighbouring knots; first 1, last 0 everywhere.

    The gate of a knot is the ramp before it less the one after it: half as many maps as two lines for each hat.
    """
    slopes = 1.0 / np.diff(knots_px)
    return np.stack([[0.0, *slopes, 0.0], [1.0, *(-knots_px[:-1] * slopes), 0.0]], axis=1)


@dataclass(frozen=True)
class _Grow:
    graph: GraphBuilder
    size: list[str]
    step: int

    def __call__(self, planes: str) -> str:
        graph = self.graph
        missing = [graph.op("Mod", graph.op("Neg", each), graph.ints([self.step])) for each in self.size]
        return graph.op("Pad", planes, graph.op("Concat", graph.ints([0] * 6), *missing, axis=0))


def _split(graph: GraphBuilder, planes: str, parts: int) -> list[str]:
    return graph.ops("Split", planes, outputs=parts, axis=1, num_outputs=parts) if parts > 1 else [planes]


def gated_model(network: BlurNetwork, weights: GatedWeights, factors: Sequence[int]) -> ModelProto:
    """Build the graph of a network without tiles from its weights, or fewer of them.

    factors: for n = 1, 2, ... the reduction of the resolution.
    """
    groups, graph = groups_of(weights, factors), GraphBuilder()
    coarsest = max(group.factor for group in groups)
    inputs = prepared(graph, network, weights, coarsest)
    windows = windows_of(graph, groups, inputs.position, inputs.size, coarsest)
    lights = [spread(graph, weights, inputs, *each) for each in zip(groups, windows, strict=True)]
    hidden = hidden_features(graph, weights, inputs, [coverage for _, coverage in lights])
    members = [(group, window, light) for group, window, (light, _) in zip(groups, windows, lights, strict=True)]
    total = total_light(graph, weights, inputs, members, hidden)
    return graph.model(graph_inputs(network), _radiance(graph, network, inputs, total), ["batch", 3, "height", "width"])


def _radiance(graph: GraphBuilder, network: BlurNetwork, inputs: GatedInputs, total: str) -> str:
    assert isinstance(network.tiles, GatedTiles)
    height, width = inputs.true_size
    whole = graph.sliced(graph.sliced(total, 0, height, 2), 0, width, 3)
    colour, coverage = graph.sliced(whole, 0, 3, 1), graph.sliced(whole, 3, 3 + network.tiles.colours, 1)
    blurred = graph.op("Div", colour, coverage)
    if network.tiles.activation != "tanh":
        return blurred
    half, one = graph.floats(0.5 * network.top), graph.floats(1.0)
    bounded = graph.op("Tanh", graph.op("Sub", graph.op("Div", blurred, half), one))
    return graph.op("Mul", graph.op("Add", bounded, one), half)


def _features(graph: GraphBuilder, network: BlurNetwork, grow: _Grow, size: list[str]) -> str:
    """Add features of place and lens, which choose between the kernels of a bin (training/networks/gated_network.py)."""
    assert isinstance(network.tiles, GatedTiles)
    if network.tiles.mixing is None:
        return ""
    weight, bias = pointwise(network.tiles.mixing.enter)
    split, total = 2 * network.field_position, graph.floats(bias[:, None, None])
    if network.field_position:
        total = graph.op("Add", times(graph, weight[:, :2], grow("place"), size), total)
    if (scale := network.lens_scale) is not None:
        log = graph.op("Sub", graph.op("Log", "lens"), graph.floats(scale.middle.numpy()))
        scaled = graph.op("Unsqueeze", graph.op("Div", log, graph.floats(scale.half_width.numpy())), graph.ints([2, 3]))
        total = graph.op("Add", graph.op("Conv", scaled, graph.floats(weight[:, split:, None, None])), total)
    return graph.op("Tanh", total)


def spread(graph: GraphBuilder, weights: GatedWeights, inputs: GatedInputs, group: Group, window: Window) -> tuple[str, str]:
    """Return (B, bins * maps, h, w) light and coverage in the window, and (B, bins * colours, H, W) coverage at full resolution."""

    def then(graph: GraphBuilder) -> list[str]:
        gated = _gated(graph, weights, inputs, group, window)
        size = [graph.size(gated, 2), graph.size(gated, 3)]
        maps = graph.op("Conv", gated, graph.floats(group.kernels), group=len(group.kernels), auto_pad="SAME_UPPER")
        by_bin = [group.count, *([weights.bases] if weights.bases > 1 else []), weights.maps]
        light = graph.op("Reshape", maps, graph.op("Concat", graph.ints([0, *by_bin]), *size, axis=0))
        if weights.bases > 1:
            light = graph.op("ReduceSum", light, graph.ints([2]), keepdims=0)
        coverage = graph.sliced(light, 3, weights.maps, 2)
        if group.factor > 1:
            light = graph.op("Mul", light, _where_covered(graph, coverage, weights.colours))
            coverage = graph.op("Relu", coverage)
        shape = graph.op("Concat", graph.ints([0, -1]), *size, axis=0)
        light, coverage = (graph.op("Reshape", each, shape) for each in (light, coverage))
        return [light, window.placed(graph, enlarged(graph, coverage, group.factor))]

    def otherwise(graph: GraphBuilder) -> list[str]:
        shape = graph.op("Concat", graph.size("rgb", 0), graph.ints([group.count * weights.colours]), *inputs.size, axis=0)
        return [graph.floats(np.zeros((1, 1, 1, 1))), graph.op("Expand", graph.floats(0.0), shape)]

    light, coverage = graph.when(window.used, then, otherwise)
    return light, coverage


def _where_covered(graph: GraphBuilder, coverage: str, colours: int) -> str:
    """Return 0 where negative lobes make a bin's coverage negative: its light is dropped too, or their ratio would be arbitrary."""
    covered = graph.op("Cast", graph.op("Greater", coverage, graph.floats(0.0)), to=1)
    return covered if colours == 1 else graph.op("Concat", covered, covered, axis=2)


def _gated(graph: GraphBuilder, weights: GatedWeights, inputs: GatedInputs, group: Group, window: Window) -> str:
    """Return (B, bins * bases * maps, h, w): the light of each bin's pixels, gathered in tents."""
    ramps = window.cut(graph, graph.sliced(inputs.ramps, group.first, group.end + 1, 1))
    gates = graph.op("Sub", graph.sliced(ramps, 0, group.count, 1), graph.sliced(ramps, 1, group.count + 1, 1))
    size = [graph.size(gates, 2), graph.size(gates, 3)]
    gated = graph.op("Mul", graph.op("Unsqueeze", gates, graph.ints([2])), window.cut(graph, inputs.light, (3, 4)))
    if weights.bases > 1:
        shares = _shares(graph, weights, group, window.cut(graph, inputs.features), size)
        gated = graph.op("Mul", shares, graph.op("Unsqueeze", gated, graph.ints([2])))
    maps = graph.op("Reshape", gated, graph.op("Concat", graph.ints([-1, len(group.kernels)]), *size, axis=0))
    return maps if group.factor == 1 else gathered(graph, maps, len(group.kernels), group.factor)


def _shares(graph: GraphBuilder, weights: GatedWeights, group: Group, features: str, size: list[str]) -> str:
    """Return (B, bins, bases, 1, h, w)."""
    weight, bias = weights.shares[group.first : group.end], weights.shares_bias[group.first : group.end]
    product = times(graph, weight.reshape(-1, weight.shape[-1]), features, size)
    logits = graph.op("Add", product, graph.floats(bias.reshape(-1, 1, 1)))
    shape = graph.op("Concat", graph.ints([-1, group.count, weights.bases, 1]), *size, axis=0)
    return graph.op("Softmax", graph.op("Reshape", logits, shape), axis=2)


def hidden_features(graph: GraphBuilder, weights: GatedWeights, inputs: GatedInputs, coverages: Sequence[str]) -> str:
    """Return (B, hidden + 1, H, W), the last one 1. coverages: of the groups in order, at full resolution."""
    of_coverages = np.repeat(weights.of_coverages / weights.colours, weights.colours, axis=0).T
    weight = np.concatenate([_on_ramps(weights), np.pad(of_coverages, ((0, 1), (0, 0)))], axis=1)
    seen = graph.op("Concat", inputs.ramps, *coverages, axis=1)
    return graph.op("Relu", times(graph, weight, seen, inputs.size))


def _on_ramps(weights: GatedWeights) -> np.ndarray:
    """Return (hidden + 1, bins + 1): the weights of the gates and the bias, rewritten for ramps; the first ramp is 1 everywhere."""
    weight = np.pad(weights.of_gates, ((1, 1), (0, 1)))
    on_ramps = np.diff(weight, axis=0)
    on_ramps[0] += np.append(weights.hidden_bias, 1.0)
    return on_ramps.T


def total_light(
    graph: GraphBuilder,
    weights: GatedWeights,
    inputs: GatedInputs,
    spread: Sequence[tuple[Group, Window, str]],
    hidden: str,
) -> str:
    """Return (B, maps, H, W): the sum over bins of weight times spread light. spread: of each group its window and its light there."""
    parts = []
    for first in range(0, len(spread), _GROUPS_AT_ONCE):
        members = spread[first : first + _GROUPS_AT_ONCE]
        of_groups = _weights(graph, weights, inputs, members, hidden)
        parts += [_weighed(graph, *member, of_group) for member, of_group in zip(members, of_groups, strict=True)]
    return functools.reduce(lambda sum_so_far, part: graph.op("Add", sum_so_far, part), parts)


def _weights(
    graph: GraphBuilder, weights: GatedWeights, inputs: GatedInputs, members: Sequence[tuple[Group, Window, str]], hidden: str
) -> list[str]:
    """Add the weights of some groups, each (B, bins, H, W); several at once, since a matrix of few rows multiplies slowly."""
    bins = slice(members[0][0].first, members[-1][0].end)
    weight = np.concatenate([weights.logits[bins], weights.logits_bias[bins, None]], axis=1)
    counts = [group.count for group, _, _ in members]

    def then(graph: GraphBuilder) -> list[str]:
        logits = times(graph, weight, hidden, inputs.size)
        of_bins = graph.op("Exp", graph.op("Clip", logits, graph.floats(-LOGIT_LIMIT), graph.floats(LOGIT_LIMIT)))
        return graph.ops("Split", of_bins, graph.ints(counts), outputs=len(counts), axis=1)

    any_used = functools.reduce(lambda a, b: graph.op("Or", a, b), (window.used for _, window, _ in members))
    return graph.when(any_used, then, _nothing(len(counts)))


def _weighed(graph: GraphBuilder, group: Group, window: Window, light: str, weights: str) -> str:
    """Return (B, maps, H, W): weight times the group's spread light, summed over its bins."""

    def then(graph: GraphBuilder) -> list[str]:
        planes = enlarged(graph, light, group.factor)
        of_bins = zip(_split(graph, window.cut(graph, weights), group.count), _split(graph, planes, group.count), strict=True)
        # one by one they stay in the cache of the processor
        total = functools.reduce(lambda a, b: graph.op("Add", a, b), [graph.op("Mul", *each) for each in of_bins])
        return [window.placed(graph, total)]

    return graph.when(window.used, then, _nothing(1))[0]


def _nothing(values: int) -> Callable[[GraphBuilder], list[str]]:
    """Return the other branch: zeros that are added at no cost, or never looked at."""
    return lambda graph: [graph.floats(np.zeros((1, 1, 1, 1))) for _ in range(values)]
