"""Where in a picture a group of bins has pixels, and how far their light goes; nothing is computed outside."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from training.fast_export.gated_groups import Group
from training.fast_export.graph_builder import GraphBuilder


@dataclass(frozen=True)
class Window:
    """Whether a group has any pixels, and the rectangle around what they reach: values of the graph, of shape () and (2,).

    starts and ends: row and column, multiples of `step`, the coarsest factor of all groups; size: of the whole picture.
    """

    used: str
    starts: str
    ends: str
    size: str

    def cut(self, graph: GraphBuilder, planes: str, axes: Sequence[int] = (2, 3)) -> str:
        """The part of planes inside."""
        return graph.op("Slice", planes, self.starts, self.ends, graph.ints(list(axes)))

    def placed(self, graph: GraphBuilder, planes: str) -> str:
        """Planes (B, C, h, w) of the window in the whole picture, zeros around them."""
        none = graph.ints([0, 0])
        return graph.op("Pad", planes, graph.op("Concat", none, self.starts, none, graph.op("Sub", self.size, self.ends), axis=0))


def windows_of(graph: GraphBuilder, groups: Sequence[Group], position: str, size: Sequence[str], step: int) -> list[Window]:
    """position: (B, 1, H, W), signed diameters; size: H and W, multiples of step."""
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
    """Steps that the light of a group goes at most, with the cells that it is gathered in and interpolated between."""
    taps = group.kernels.shape[-1] // 2
    return -(-group.factor * (taps + (2 if group.factor > 1 else 0)) // step)
