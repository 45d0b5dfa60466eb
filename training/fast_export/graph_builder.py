"""Writing an ONNX graph node by node."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from onnx import ModelProto, TensorProto, helper, numpy_helper

from training.fast_export.coarse_kernels import tent

OPSET, IR_VERSION = 18, 9


class GraphBuilder:
    """Collects nodes and constants; values are names. Branches see the values of the graph around them."""

    def __init__(self, names: "itertools.count[int] | None" = None) -> None:
        self._names = itertools.count() if names is None else names
        self._nodes: list[Any] = []
        self._constants: list[TensorProto] = []

    def op(self, kind: str, *inputs: str, **attributes: Any) -> str:
        """A node with one output, whose name is returned."""
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
        """value[start:end] along an axis; a bound given by name is a value of the graph of shape (1,)."""
        bounds = [each if isinstance(each, str) else self.ints([each]) for each in (start, end)]
        return self.op("Slice", value, *bounds, self.ints([axis]))

    def size(self, value: str, axis: int) -> str:
        """The length of a value along an axis, shape (1,)."""
        return self.op("Shape", value, start=axis, end=axis + 1)

    def when(
        self, condition: str, then: Callable[["GraphBuilder"], Sequence[str]], otherwise: Callable[["GraphBuilder"], Sequence[str]]
    ) -> list[str]:
        """Only one of the two is computed. Both give as many values."""
        branches = {}
        for name, write in (("then_branch", then), ("else_branch", otherwise)):
            inside = GraphBuilder(self._names)
            branches[name] = inside._graph(name, [], list(write(inside)))
        return self.ops("If", condition, outputs=len(branches["then_branch"].output), **branches)

    def model(self, inputs: dict[str, list[int | str]], output: str, shape: list[int | str]) -> ModelProto:
        """The whole, with `output` renamed to "blurred". inputs: name to shape, free sizes as names."""
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
    """Light in coarse pixels, by tents (`coarse_kernels.tent`); sides must be multiples of the factor."""
    shares = np.tile(np.outer(tent(factor), tent(factor)), (channels, 1, 1, 1))
    return graph.op("Conv", planes, graph.floats(shares), group=channels, strides=[factor] * 2, pads=[factor // 2] * 4)


def enlarged(graph: GraphBuilder, planes: str, factor: int) -> str:
    """Linear interpolation between the centres of coarse pixels."""
    if factor == 1:
        return planes
    return graph.op("Resize", planes, "", graph.floats([1, 1, factor, factor]), mode="linear", coordinate_transformation_mode="half_pixel")


def _value(name: str, sizes: list[int | str] | None) -> Any:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, sizes)
