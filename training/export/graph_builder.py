"""Writing an ONNX graph node by node, and kernels at a fraction of the resolution.

Light is gathered in tents, convolved with few taps and interpolated. Tents are linear interpolation in reverse: a pixel gives its light
to the neighbouring cells by nearness, so that the light's centre of mass is kept (a plain mean over cells would move it by up to half a
cell). A pixel at place p of its cell of s x s, spread by coarse taps K and brought back, ends as E_p K E_p'^T with
E_p[d, j] = sum over cells c of tent(p, c) hat((p + d + 1/2) / s - 1/2 - j - c) / s, d counting pixels from p and j cells. K has
the least squared difference to the kernel over all s^2 places, scaled to its sum: light is conserved.
It undoes the smoothing of tents and interpolation with small negative lobes at the rim of a disc; without them the loss is two to
four times as large.
"""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from jaxtyping import Float, Float64
from onnx import ModelProto, TensorProto, helper, numpy_helper

_RIDGE = 1e-6  # tents are nearly linearly dependent
OPSET, IR_VERSION = 18, 9


def taps_radius(radius_px: int, factor: int) -> int:
    """Return the cells on each side that a kernel of this radius reaches, including one for interpolation."""
    return max(1, -(-(2 * radius_px + 1) // (2 * factor)))


def coarse_kernel(kernel: Float[np.ndarray, "size size"], factor: int) -> Float64[np.ndarray, "taps taps"]:
    """Return the taps of a kernel (size odd, values >= 0) at 1/factor of the resolution."""
    responses = place_responses(kernel.shape[0] // 2, factor)
    gram, mean = np.einsum("pdi,pdj->ij", responses, responses), responses.sum(axis=0)
    solved = np.linalg.inv(gram + _RIDGE * gram.max() * np.eye(len(gram)))
    taps = solved @ (mean.T @ _padded(kernel, mean.shape[0]) @ mean) @ solved
    return taps * (kernel.sum(dtype=np.float64) / taps.sum())


def binned(kernels: Float[np.ndarray, "maps size size"], factor: int) -> Float[np.ndarray, "maps taps taps"]:
    """Bin kernels that may be negative, for maps that stay coarse: every value goes to neighbouring cells by nearness; sums are kept."""
    radius = kernels.shape[-1] // 2
    taps = -(-radius // factor)
    away, cells = np.arange(-radius, radius + 1) / factor, np.arange(-taps, taps + 1)
    shares = np.maximum(0.0, 1.0 - np.abs(away[:, None] - cells))
    return np.einsum("mij,ia,jb->mab", kernels, shares, shares).astype(kernels.dtype)


def tent(factor: int) -> Float64[np.ndarray, " pixels"]:
    """Return the shares of the 2 * factor pixels around the centre of a cell that it gathers, along one side; their sum is 1."""
    away = (np.arange(2 * factor) + 0.5) / factor - 1.0
    return (1.0 - np.abs(away)) / factor


def place_responses(radius_px: int, factor: int) -> Float64[np.ndarray, "factor reach taps"]:
    """Return E_p for every place p; the reach in pixels covers everything that the taps can touch."""
    taps = taps_radius(radius_px, factor)
    reach = factor * (taps + 3)
    away, cells, places = np.arange(-reach, reach + 1), np.arange(-taps, taps + 1), np.arange(factor)
    responses = np.zeros((factor, len(away), len(cells)))
    for gatherer in (-1, 0, 1):
        share = np.maximum(0.0, 1.0 - np.abs((places + 0.5) / factor - 0.5 - gatherer))
        where = (places[:, None, None] + away[:, None] + 0.5) / factor - 0.5 - cells - gatherer
        responses += share[:, None, None] * np.maximum(0.0, 1.0 - np.abs(where)) / factor
    return responses


def _padded(kernel: np.ndarray, size: int) -> np.ndarray:
    return np.pad(kernel.astype(np.float64), (size - kernel.shape[0]) // 2)


class GraphBuilder:
    """A collector of nodes and constants; values are names. Branches see the values of the graph around them."""

    def __init__(self, names: "itertools.count[int] | None" = None) -> None:
        self._names = itertools.count() if names is None else names
        self._nodes: list[Any] = []
        self._constants: list[TensorProto] = []

    def op(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """Add a node with one output and return its name."""
        return self.ops(kind, *inputs, outputs=1, **attributes)[0]

    def ops(self, kind: str, *inputs: str, outputs: int, **attributes: Any) -> list[str]:
        names = [f"{kind.lower()}_{next(self._names)}" for _ in range(outputs)]
        self._nodes.append(helper.make_node(kind, list(inputs), names, **attributes))
        return names

    def floats(self, values: Any) -> str:
        return self._constant(np.asarray(values, np.float32))

    def ints(self, values: Any) -> str:
        return self._constant(np.asarray(values, np.int64))

    def sliced(self, value: str, start: int | str, end: int | str, axis: int) -> str:
        """Return value[start:end] along an axis; a bound given by name is a value of the graph of shape (1,)."""
        bounds = [each if isinstance(each, str) else self.ints([each]) for each in (start, end)]
        return self.op("Slice", value, *bounds, self.ints([axis]))

    def size(self, value: str, axis: int) -> str:
        """Return the length of a value along an axis, shape (1,)."""
        return self.op("Shape", value, start=axis, end=axis + 1)

    def when(
        self, condition: str, then: Callable[["GraphBuilder"], Sequence[str]], otherwise: Callable[["GraphBuilder"], Sequence[str]]
    ) -> list[str]:
        """Add an `If`, of which only one branch is computed. Both give as many values."""
        branches = {}
        for name, write in (("then_branch", then), ("else_branch", otherwise)):
            inside = GraphBuilder(self._names)
            branches[name] = inside._graph(name, [], list(write(inside)))
        return self.ops("If", condition, outputs=len(branches["then_branch"].output), **branches)

    def model(self, inputs: dict[str, list[int | str]], output: str, shape: list[int | str]) -> ModelProto:
        """Return the whole model, with `output` renamed to "blurred". inputs: name to shape, free sizes as names."""
        self._nodes.append(helper.make_node("Identity", [output], ["blurred"]))
        graph = self._graph("network", [_value(name, sizes) for name, sizes in inputs.items()], [])
        graph.output.append(_value("blurred", shape))
        return helper.make_model(graph, opset_imports=[helper.make_opsetid("", OPSET)], ir_version=IR_VERSION)

    def _constant(self, array: np.ndarray) -> str:
        name = f"constant_{next(self._names)}"
        self._constants.append(numpy_helper.from_array(np.ascontiguousarray(array), name))
        return name

    def _graph(self, name: str, inputs: list[Any], outputs: list[str]) -> Any:
        return helper.make_graph(self._nodes, name, inputs, [_value(each, None) for each in outputs], self._constants)


def gathered(graph: GraphBuilder, planes: str, channels: int, factor: int) -> str:
    """Gather light in coarse pixels, by tents (`tent`); sides must be multiples of the factor."""
    shares = np.tile(np.outer(tent(factor), tent(factor)), (channels, 1, 1, 1))
    return graph.op("Conv", planes, graph.floats(shares), group=channels, strides=[factor] * 2, pads=[factor // 2] * 4)


def enlarged(graph: GraphBuilder, planes: str, factor: int) -> str:
    """Interpolate linearly between the centres of coarse pixels."""
    if factor == 1:
        return planes
    return graph.op("Resize", planes, "", graph.floats([1, 1, factor, factor]), mode="linear", coordinate_transformation_mode="half_pixel")


def _value(name: str, sizes: list[int | str] | None) -> Any:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, sizes)
