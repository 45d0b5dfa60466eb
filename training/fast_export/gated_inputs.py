"""What every part of the gated graph reads: light, gates and the sizes of the picture at each resolution."""

from dataclasses import dataclass

import numpy as np
from onnx import numpy_helper

from training.fast_export.gated_weights import GatedWeights, pointwise
from training.fast_export.graph_builder import GraphBuilder
from training.gated_network import GatedTiles
from training.network import BlurNetwork

_ONE = numpy_helper.from_array(np.ones(1, np.float32))


@dataclass(frozen=True)
class GatedInputs:
    """Names of values at full resolution, with zeros added below and right so that the coarsest pixels are whole.

    light: (B, 1, maps, H, W), the colours and ones; ramps: (B, bins + 1, H, W), see `ramp_lines`; features: (B, features, H, W) of place
    and lens, or ""; position: (B, 1, H, W), the circle of confusion that gates look at; size: H and W; true_size: before zeros were added.
    """

    light: str
    ramps: str
    features: str
    position: str
    size: list[str]
    true_size: list[str]


def graph_inputs(network: BlurNetwork) -> dict[str, list[int | str]]:
    """Name to shape."""
    planes: dict[str, list[int | str]] = {"rgb": ["batch", 3, "height", "width"], "coc_px": ["batch", 1, "height", "width"]}
    if network.field_position:
        planes["place"] = ["batch", 2, "height", "width"]
    if network.lens_scale is not None:
        planes["lens"] = ["batch", 2]
    return planes


def prepared(graph: GraphBuilder, network: BlurNetwork, weights: GatedWeights, coarsest: int) -> GatedInputs:
    """coarsest: factor of all groups."""
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
    return GatedInputs(graph.op("Unsqueeze", light, graph.ints([1])), ramps, features, position, whole, true_size)


def times(graph: GraphBuilder, weight: np.ndarray, planes: str, size: list[str]) -> str:
    """weight (outputs, inputs) at every pixel: as a matrix product, for a Conv first brings the planes into another layout."""
    flat = graph.op("Reshape", planes, graph.ints([0, weight.shape[1], -1]))
    product = graph.op("MatMul", graph.floats(weight), flat)
    return graph.op("Reshape", product, graph.op("Concat", graph.ints([0, len(weight)]), *size, axis=0))


def ramp_lines(knots_px: np.ndarray) -> np.ndarray:
    """(bins + 1, 2), slope and offset: lines that, clipped to [0, 1], rise between neighbouring knots; 1 before them all, 0 after.

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


def _features(graph: GraphBuilder, network: BlurNetwork, grow: _Grow, size: list[str]) -> str:
    """Add features of place and lens, which choose between the kernels of a bin (training/field_mixing.py)."""
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
