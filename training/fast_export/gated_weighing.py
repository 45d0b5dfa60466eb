"""Second round of the gated graph: a pointwise network sees gates and coverages, and its weights add up what the bins spread."""

import functools
from collections.abc import Callable, Sequence

import numpy as np

from training.fast_export.gated_groups import Group
from training.fast_export.gated_inputs import GatedInputs, times
from training.fast_export.gated_weights import GatedWeights
from training.fast_export.gated_windows import Window
from training.fast_export.graph_builder import GraphBuilder, enlarged
from training.gated_network import LOGIT_LIMIT

_GROUPS_AT_ONCE = 5


def hidden_features(graph: GraphBuilder, weights: GatedWeights, inputs: GatedInputs, coverages: Sequence[str]) -> str:
    """(B, hidden + 1, H, W), the last one 1. coverages: of the groups in order, at full resolution."""
    of_coverages = np.repeat(weights.of_coverages / weights.colours, weights.colours, axis=0).T
    weight = np.concatenate([_on_ramps(weights), np.pad(of_coverages, ((0, 1), (0, 0)))], axis=1)
    seen = graph.op("Concat", inputs.ramps, *coverages, axis=1)
    return graph.op("Relu", times(graph, weight, seen, inputs.size))


def _on_ramps(weights: GatedWeights) -> np.ndarray:
    """(hidden + 1, bins + 1): what acts on gates, and the bias, acting on ramps; the first ramp is 1 everywhere."""
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
    """(B, maps, H, W): the sum over bins of weight times spread light. spread: of each group its window and what it spreads there."""
    parts = []
    for first in range(0, len(spread), _GROUPS_AT_ONCE):
        members = spread[first : first + _GROUPS_AT_ONCE]
        of_groups = _weights(graph, weights, inputs, members, hidden)
        parts += [_weighed(graph, *member, of_group) for member, of_group in zip(members, of_groups, strict=True)]
    return functools.reduce(lambda sum_so_far, part: graph.op("Add", sum_so_far, part), parts)


def _weights(
    graph: GraphBuilder, weights: GatedWeights, inputs: GatedInputs, members: Sequence[tuple[Group, Window, str]], hidden: str
) -> list[str]:
    """Add the weights of some groups, each (B, bins, H, W); several at once, for a matrix of few rows is slow to multiply with."""
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
    """(B, maps, H, W): weight times what the group spreads, summed over its bins."""

    def then(graph: GraphBuilder) -> list[str]:
        planes = enlarged(graph, light, group.factor)
        of_bins = zip(_split(graph, window.cut(graph, weights), group.count), _split(graph, planes, group.count), strict=True)
        # one by one they stay in the cache of the processor
        total = functools.reduce(lambda a, b: graph.op("Add", a, b), [graph.op("Mul", *each) for each in of_bins])
        return [window.placed(graph, total)]

    return graph.when(window.used, then, _nothing(1))[0]


def _nothing(values: int) -> Callable[[GraphBuilder], list[str]]:
    """The other branch: zeros that are added at no cost, or never looked at."""
    return lambda graph: [graph.floats(np.zeros((1, 1, 1, 1))) for _ in range(values)]


def _split(graph: GraphBuilder, planes: str, parts: int) -> list[str]:
    return graph.ops("Split", planes, outputs=parts, axis=1, num_outputs=parts) if parts > 1 else [planes]
