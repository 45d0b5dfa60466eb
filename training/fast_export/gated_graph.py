"""The gated form as a graph: light is gated at full resolution, spread at that of its group and weighed at full resolution again.

Groups to which no pixel belongs are skipped, others are computed where their light goes. In words of training/gated_network.py: a first
round gives what every group spreads, then the pointwise network sees gates and coverages, and a second round adds up weight times
spread light.
"""

from collections.abc import Sequence

from onnx import ModelProto

from training.fast_export.gated_groups import groups_of
from training.fast_export.gated_inputs import GatedInputs, graph_inputs, prepared
from training.fast_export.gated_spread import spread
from training.fast_export.gated_weighing import hidden_features, total_light
from training.fast_export.gated_weights import GatedWeights
from training.fast_export.gated_windows import windows_of
from training.fast_export.graph_builder import GraphBuilder
from training.gated_network import GatedTiles
from training.network import BlurNetwork


def gated_model(network: BlurNetwork, weights: GatedWeights, factors: Sequence[int]) -> ModelProto:
    """Build the graph of a network without tiles from its weights, or fewer of them.

    factors: for n = 1, 2, ... by how much the resolution is lowered.
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
