"""Slices of a picture on a device: which pixels belong to which, and in what order their light claims the pupil."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from jaxtyping import Float32, Int32
from torch import Tensor


class Box(NamedTuple):
    """First row, first column, rows and columns."""

    top: int
    left: int
    rows: int
    columns: int

    def grown(self, by_px: int) -> "Box":
        return Box(self.top - by_px, self.left - by_px, self.rows + 2 * by_px, self.columns + 2 * by_px)

    def within(self, other: "Box") -> "Box":
        """Return the part of it in another one, of no rows or no columns if there is none."""
        top, left = max(self.top, other.top), max(self.left, other.left)
        bottom = min(self.top + self.rows, other.top + other.rows)
        right = min(self.left + self.columns, other.left + other.columns)
        return Box(top, left, max(bottom - top, 0), max(right - left, 0))


class Slice(NamedTuple):
    """Pixels of one kind whose circles of confusion are nearest to `number` steps, and the box that holds them.

    joins: whether they claim the pupil together with the slice before.
    """

    kind: int
    number: int
    box: Box
    joins: bool = False


@dataclass(frozen=True)
class Slices:
    """Layers of one size on a device, cut into slices.

    values (L, H, W, 4), coc_px (L, H, W): light and signed diameters of each layer. shares (K, H, W): how much of each pixel is meant by
    each kind; kind 0 takes pixels of layer 0, the others of layer 1. step_px: between slices; inf for a single one. slices: in the order
    in which they claim the pupil. order (K, N): the place of each kind and number, from `first` on, in that order; -1 for none.
    frame: the part of the arrays that is seen. largest_px: no diameter is larger.
    """

    values: Float32[Tensor, "layers height width 4"]
    coc_px: Float32[Tensor, "layers height width"]
    shares: Float32[Tensor, "kinds height width"]
    slices: list[Slice]
    order: Int32[Tensor, "kinds numbers"]
    first: int
    step_px: float
    frame: Box
    largest_px: float

    @classmethod
    def single(cls, values: Float32[Tensor, "height width 4"], coc_px: Float32[Tensor, "height width"], largest_px: float) -> "Slices":
        """Make one slice of all pixels of a picture."""
        frame = Box(0, 0, *coc_px.shape)
        order = torch.zeros((1, 1), dtype=torch.int32, device=values.device)
        shares = torch.ones_like(coc_px)[None]
        return cls(values[None], coc_px[None], shares, [Slice(0, 0, frame)], order, 0, math.inf, frame, largest_px)

    def range_px(self, number: int) -> tuple[float, float]:
        """Return between which sizes the diameters of a slice lie, with what rounding may add."""
        if not math.isfinite(self.step_px):
            return 0.0, self.largest_px
        return max(abs(number) - 0.501, 0.0) * self.step_px, min((abs(number) + 0.501) * self.step_px, self.largest_px)
