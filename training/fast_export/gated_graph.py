"""The gated form as a graph: light is gated at full resolution, spread at that of its group and weighed at full resolution again.

Groups to which no pixel belongs are skipped. In words of training/gated_network.py: a first round gives what every group spreads, then the
pointwise network sees gates and coverages, and a second round adds up weight times spread light.
"""

import functools
from collections.abc import Callable, Sequence

import numpy as np
from onnx import ModelProto, numpy_helper
from torch import nn

from training.fast_export.gated_groups import Group, groups_of
from training.fast_export.graph_builder import GraphBuilder, enlarged, gathered
from training.gated_network import LOGIT_LIMIT, GatedTiles
from training.network import BlurNetwork

_BUCKETS_PER_PX = 4
_GROUPS_AT_ONCE = 4
_ONE = numpy_helper.from_array(np.ones(1, np.float32))


class GatedGraph:
    """Writes the graph of one network without tiles; `factors` says for every n by how much the resolution of its kernels is lowered."""

    def __init__(self, network: BlurNetwork, factors: dict[int, int]) -> None:
        assert isinstance(network.tiles, GatedTiles)
        self.network, self.tiles = network, network.tiles
        self.groups = groups_of(network.tiles, factors)
        self.coarsest = max(factors.values())
        self.maps = 3 + self.tiles.colours
        self.graph = GraphBuilder()

    def model(self) -> ModelProto:
        graph = self.graph
        self._prepare()
        used = self._used_groups()
        spread = [self._spread(group, used[i]) for i, group in enumerate(self.groups)]
        hidden = self._hidden([coverage for _, coverage in spread])
        parts = []
        for first in range(0, len(self.groups), _GROUPS_AT_ONCE):
            members = range(first, min(first + _GROUPS_AT_ONCE, len(self.groups)))
            weights = self._weights(members, used, hidden)
            parts += [self._weighed(self.groups[i], used[i], spread[i][0], weights[i - first]) for i in members]
        total = functools.reduce(lambda sum_so_far, part: graph.op("Add", sum_so_far, part), parts)
        return graph.model(self._inputs(), self._radiance(total), ["batch", 3, "height", "width"])

    def _inputs(self) -> dict[str, list[int | str]]:
        planes: dict[str, list[int | str]] = {"rgb": ["batch", 3, "height", "width"], "coc_px": ["batch", 1, "height", "width"]}
        if self.network.field_position:
            planes["place"] = ["batch", 2, "height", "width"]
        if self.network.lens_scale is not None:
            planes["lens"] = ["batch", 2]
        return planes

    def _prepare(self) -> None:
        """Everything at full resolution, with zeros added below and right so that the coarsest pixels are whole."""
        graph = self.graph
        self.true_height, self.true_width = graph.size("rgb", 2), graph.size("rgb", 3)
        ones = graph.op("Expand", graph.floats(np.ones((1, self.tiles.colours, 1, 1))), self._shape_of("coc_px", self.tiles.colours))
        self.light = graph.op("Unsqueeze", self._grown(graph.op("Concat", "rgb", ones, axis=1)), graph.ints([1]))
        limit = graph.floats(self.network.largest_coc_px)
        signed = "coc_px" if self.network.signed_coc else graph.op("Abs", "coc_px")
        self.true_position = graph.op("Clip", signed, graph.op("Neg", limit), limit)
        position = self._grown(self.true_position)
        self.sizes = {1: [graph.size(position, 2), graph.size(position, 3)]}
        for factor in sorted({group.factor for group in self.groups} - {1}):
            self.sizes[factor] = [graph.op("Div", each, graph.ints([factor])) for each in self.sizes[1]]
        with_one = graph.op("Concat", position, graph.op("ConstantOfShape", graph.op("Shape", position), value=_ONE), axis=1)
        self.ramps = graph.op("Clip", self._pointwise(with_one, _ramps(self.tiles.knots)), graph.floats(0.0), graph.floats(1.0))
        self.features = None if self.tiles.mixing is None else self._features()

    def _shape_of(self, value: str, channels: int) -> str:
        graph = self.graph
        return graph.op("Concat", graph.size(value, 0), graph.ints([channels]), self.true_height, self.true_width, axis=0)

    def _grown(self, planes: str) -> str:
        graph, step = self.graph, self.graph.ints([self.coarsest])
        missing = [graph.op("Mod", graph.op("Neg", each), step) for each in (self.true_height, self.true_width)]
        return graph.op("Pad", planes, graph.op("Concat", graph.ints([0] * 6), *missing, axis=0))

    def _pointwise(self, planes: str, weight: np.ndarray, graph: GraphBuilder | None = None, factor: int = 1) -> str:
        """weight (outputs, inputs) at every pixel: as a matrix product, for a Conv first brings the planes into another layout."""
        graph = graph or self.graph
        flat = graph.op("Reshape", planes, graph.ints([0, weight.shape[1], -1]))
        product = graph.op("MatMul", graph.floats(weight), flat)
        return graph.op("Reshape", product, graph.op("Concat", graph.ints([0, len(weight)]), *self.sizes[factor], axis=0))

    def _features(self) -> str:
        """Of place and lens, which choose between the kernels of a bin (training/field_mixing.py)."""
        graph, mixing = self.graph, self.tiles.mixing
        assert mixing is not None
        weight, bias = _pointwise_of(mixing.enter)
        split, total = 2 * self.network.field_position, graph.floats(bias[:, None, None])
        if self.network.field_position:
            total = graph.op("Add", self._pointwise(self._grown("place"), weight[:, :2]), total)
        if (scale := self.network.lens_scale) is not None:
            log = graph.op("Sub", graph.op("Log", "lens"), graph.floats(scale.middle.numpy()))
            scaled = graph.op("Unsqueeze", graph.op("Div", log, graph.floats(scale.half_width.numpy())), graph.ints([2, 3]))
            total = graph.op("Add", graph.op("Conv", scaled, graph.floats(weight[:, split:, None, None])), total)
        return graph.op("Tanh", total)

    def _used_groups(self) -> list[str]:
        """For every group whether any pixel belongs to it: the circles of confusion of the picture are marked on a ruler."""
        graph, largest = self.graph, self.network.largest_coc_px
        length = int(np.ceil(2 * largest * _BUCKETS_PER_PX)) + 2
        offset = graph.op("Add", self.true_position, graph.floats(largest))
        bucket = graph.op("Floor", graph.op("Mul", offset, graph.floats(_BUCKETS_PER_PX)))
        index = graph.op("Reshape", graph.op("Cast", bucket, to=7), graph.ints([-1]))
        marks = graph.op("Expand", graph.floats([1.0]), graph.op("Shape", index))
        ruler = graph.op("ScatterElements", graph.floats(np.zeros(length)), index, marks, axis=0)
        low = np.arange(length) / _BUCKETS_PER_PX - largest
        belongs = [np.any([(low <= b) & (low + 1 / _BUCKETS_PER_PX >= a) for a, b in group.spans_px], axis=0) for group in self.groups]
        counts = graph.op("MatMul", ruler, graph.floats(np.stack(belongs, axis=1)))
        used = graph.op("Greater", counts, graph.floats(0.5))
        return [graph.op("Gather", used, graph.ints(i)) for i in range(len(self.groups))]

    def _spread(self, group: Group, used: str) -> tuple[str, str]:
        """(light and coverage, coverage alone), both (B, bins * maps, h, w) at the resolution of the group."""
        height, width = self.sizes[group.factor]
        count = len(group.bins) * self.tiles.colours

        def then(graph: GraphBuilder) -> list[str]:
            maps = graph.op("Conv", self._gated(graph, group), graph.floats(group.weights), group=len(group.weights), auto_pad="SAME_UPPER")
            by_bin = [len(group.bins), *([self.tiles.bases] if self.tiles.bases > 1 else []), self.maps]
            spread = graph.op("Reshape", maps, graph.op("Concat", graph.ints([0, *by_bin]), height, width, axis=0))
            if self.tiles.bases > 1:
                spread = graph.op("ReduceSum", spread, graph.ints([2]), keepdims=0)
            coverage = graph.sliced(spread, 3, self.maps, 2)
            if group.factor > 1:
                spread = graph.op("Mul", spread, self._where_covered(graph, coverage))
                coverage = graph.op("Relu", coverage)
            shape = graph.op("Concat", graph.ints([0, -1]), height, width, axis=0)
            return [graph.op("Reshape", each, shape) for each in (spread, coverage)]

        def otherwise(graph: GraphBuilder) -> list[str]:
            shape = graph.op("Concat", graph.size("rgb", 0), graph.ints([count]), height, width, axis=0)
            return [graph.floats(np.zeros((1, 1, 1, 1))), graph.op("Expand", graph.floats(0.0), shape)]

        light, coverage = self.graph.when(used, then, otherwise)
        return light, coverage

    def _where_covered(self, graph: GraphBuilder, coverage: str) -> str:
        """0 where negative lobes leave less than nothing of a bin: its light goes too, or their ratio would be anything."""
        covered = graph.op("Cast", graph.op("Greater", coverage, graph.floats(0.0)), to=1)
        return covered if self.tiles.colours == 1 else graph.op("Concat", covered, covered, axis=2)

    def _gated(self, graph: GraphBuilder, group: Group) -> str:
        """(B, bins * bases * maps, h, w): the light of each bin's pixels, gathered in tents."""
        gates = graph.op("Unsqueeze", self._gates(graph, group), graph.ints([2]))
        gated = graph.op("Mul", gates, self.light)
        if self.tiles.bases > 1:
            gated = graph.op("Mul", self._shares(graph, group), graph.op("Unsqueeze", gated, graph.ints([2])))
        maps = graph.op("Reshape", gated, graph.op("Concat", graph.ints([-1, len(group.weights)]), *self.sizes[1], axis=0))
        return maps if group.factor == 1 else gathered(graph, maps, len(group.weights), group.factor)

    def _gates(self, graph: GraphBuilder, group: Group) -> str:
        ascending = sorted(self.tiles.knots)
        places = np.array([ascending.index(self.tiles.knots[each]) for each in group.bins])
        risen, fallen = (graph.op("Gather", self.ramps, graph.ints(each), axis=1) for each in (places, places + 1))
        return graph.op("Sub", risen, fallen)

    def _shares(self, graph: GraphBuilder, group: Group) -> str:
        """(B, bins, bases, 1, H, W)."""
        mixing = self.tiles.mixing
        assert mixing is not None and self.features is not None
        weight = mixing.weight.detach()[0, list(group.bins)].reshape(-1, mixing.hidden).numpy()
        bias = mixing.bias.detach()[0, list(group.bins)].reshape(-1, 1, 1).numpy()
        logits = graph.op("Add", self._pointwise(self.features, weight, graph), graph.floats(bias))
        shape = graph.op("Concat", graph.ints([-1, len(group.bins), mixing.bases, 1]), *self.sizes[1], axis=0)
        return graph.op("Softmax", graph.op("Reshape", logits, shape), axis=2)

    def _hidden(self, coverages: list[str]) -> str:
        """The hidden features of the pointwise network; coverage enters them at its own resolution, for both steps are linear."""
        graph, bins = self.graph, len(self.tiles.knots)
        weight, bias = _pointwise_of(self.tiles.hide_in)
        on_ramps = _on_ramps(weight[:, :bins], self.tiles.knots)
        on_ramps[:, 0] += bias  # the first ramp is 1 everywhere
        total = self._pointwise(self.ramps, on_ramps)
        for factor in self.sizes:
            members = [i for i, group in enumerate(self.groups) if group.factor == factor]
            if members:
                planes = graph.op("Concat", *(coverages[i] for i in members), axis=1)
                of_bins = weight[:, [bins + each for i in members for each in self.groups[i].bins]]
                part = self._pointwise(planes, np.repeat(of_bins / self.tiles.colours, self.tiles.colours, axis=1), factor=factor)
                total = graph.op("Add", total, enlarged(graph, part, factor))
        return graph.op("Relu", total)

    def _weights(self, members: Sequence[int], used: Sequence[str], hidden: str) -> list[str]:
        """For some groups, each (B, bins, H, W); several at once, for a matrix of few rows is slow to multiply with."""
        graph, counts = self.graph, [len(self.groups[i].bins) for i in members]
        bins = [each for i in members for each in self.groups[i].bins]
        weight, bias = (each[bins] for each in _pointwise_of(self.tiles.hide_out))

        def then(graph: GraphBuilder) -> list[str]:
            logits = graph.op("Add", self._pointwise(hidden, weight, graph), graph.floats(bias[:, None, None]))
            weights = graph.op("Exp", graph.op("Clip", logits, graph.floats(-LOGIT_LIMIT), graph.floats(LOGIT_LIMIT)))
            return graph.ops("Split", weights, graph.ints(counts), outputs=len(counts), axis=1)

        return graph.when(functools.reduce(lambda a, b: graph.op("Or", a, b), (used[i] for i in members)), then, _nothing(len(counts)))

    def _weighed(self, group: Group, used: str, light: str, weights: str) -> str:
        """(B, maps, H, W): weight times what the group spreads, summed over its bins."""

        def then(graph: GraphBuilder) -> list[str]:
            planes = enlarged(graph, light, group.factor)
            of_bins = zip(_split(graph, weights, len(group.bins)), _split(graph, planes, len(group.bins)), strict=True)
            total = None
            for weight_of_bin, light_of_bin in of_bins:  # one by one they stay in the cache of the processor
                part = graph.op("Mul", weight_of_bin, light_of_bin)
                total = part if total is None else graph.op("Add", total, part)
            assert total is not None
            return [total]

        return self.graph.when(used, then, _nothing(1))[0]

    def _radiance(self, total: str) -> str:
        graph = self.graph
        whole = graph.sliced(graph.sliced(total, 0, self.true_height, 2), 0, self.true_width, 3)
        colour, coverage = graph.sliced(whole, 0, 3, 1), graph.sliced(whole, 3, self.maps, 1)
        blurred = graph.op("Div", colour, coverage)
        if self.tiles.activation != "tanh":
            return blurred
        half, one = graph.floats(0.5 * self.network.top), graph.floats(1.0)
        bounded = graph.op("Tanh", graph.op("Sub", graph.op("Div", blurred, half), one))
        return graph.op("Mul", graph.op("Add", bounded, one), half)


def _nothing(values: int) -> Callable[[GraphBuilder], list[str]]:
    """The other branch: zeros that are added at no cost, or never looked at."""
    return lambda graph: [graph.floats(np.zeros((1, 1, 1, 1))) for _ in range(values)]


def _split(graph: GraphBuilder, planes: str, parts: int) -> list[str]:
    return graph.ops("Split", planes, outputs=parts, axis=1, num_outputs=parts) if parts > 1 else [planes]


def _pointwise_of(convolution: nn.Conv2d) -> tuple[np.ndarray, np.ndarray]:
    assert convolution.bias is not None
    return convolution.weight.detach()[:, :, 0, 0].numpy(), convolution.bias.detach().numpy()


def _ramps(knots: list[float]) -> np.ndarray:
    """(bins + 1, 2), slope and offset: lines that, clipped to [0, 1], rise between neighbouring knots; 1 before them all, 0 after.

    The gate of a knot is the ramp before it less the one after it: half as many maps as two lines for each hat.
    """
    ascending = np.sort(knots)
    slopes = 1.0 / np.diff(ascending)
    return np.stack([[0.0, *slopes, 0.0], [1.0, *(-ascending[:-1] * slopes), 0.0]], axis=1)


def _on_ramps(weight: np.ndarray, knots: list[float]) -> np.ndarray:
    """(features, bins) acting on gates, as (features, bins + 1) acting on ramps."""
    by_knot = weight[:, np.argsort(knots)]
    return np.pad(by_knot, ((0, 0), (0, 1))) - np.pad(by_knot, ((0, 0), (1, 0)))
