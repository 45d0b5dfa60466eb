"""First round of the gated graph: what the bins of a group spread, at the resolution of the group."""

import numpy as np

from training.fast_export.gated_groups import Group
from training.fast_export.gated_inputs import GatedInputs, times
from training.fast_export.gated_weights import GatedWeights
from training.fast_export.gated_windows import Window
from training.fast_export.graph_builder import GraphBuilder, enlarged, gathered


def spread(graph: GraphBuilder, weights: GatedWeights, inputs: GatedInputs, group: Group, window: Window) -> tuple[str, str]:
    """(B, bins * maps, h, w) light and coverage in the window, and (B, bins * colours, H, W) the coverage everywhere at full resolution."""

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
    """0 where negative lobes leave less than nothing of a bin: its light goes too, or their ratio would be anything."""
    covered = graph.op("Cast", graph.op("Greater", coverage, graph.floats(0.0)), to=1)
    return covered if colours == 1 else graph.op("Concat", covered, covered, axis=2)


def _gated(graph: GraphBuilder, weights: GatedWeights, inputs: GatedInputs, group: Group, window: Window) -> str:
    """(B, bins * bases * maps, h, w): the light of each bin's pixels, gathered in tents."""
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
    """(B, bins, bases, 1, h, w)."""
    weight, bias = weights.shares[group.first : group.end], weights.shares_bias[group.first : group.end]
    product = times(graph, weight.reshape(-1, weight.shape[-1]), features, size)
    logits = graph.op("Add", product, graph.floats(bias.reshape(-1, 1, 1)))
    shape = graph.op("Concat", graph.ints([-1, group.count, weights.bases, 1]), *size, axis=0)
    return graph.op("Softmax", graph.op("Reshape", logits, shape), axis=2)
