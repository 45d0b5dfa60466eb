"""Slices laid out one after the other in the memory of a device."""

import math
from dataclasses import dataclass

import torch
from jaxtyping import Float32, Int32, Int64
from torch import Tensor

from mrbokeh.layering.torch_layering.slicing import Slices
from mrbokeh.renderers.polygon.torch_polygon._corners import DeviceTables

_BITS = {torch.int32: 31, torch.int64: 62}


@dataclass(frozen=True)
class Batch:
    """Slices with their windows on the device.

    places (S, 11), whole numbers: kind, number, window (top, left, rows, columns), the part of it that lies in the frame (the same four),
    and 1 where whole small kernels are needed, 2 where sums are, and 4 times its margin, which holds no pixels. starts (S, 2): of the window, in cells, and of its visible part, in
    pixels, when all lie one after the other. scales (S, 2): units of one in the sums, and what one of them means in the picture.
    most: rows and columns of the largest window. cells, pixels: of all windows, and of all that is visible.
    """

    slices: Slices
    places: Int32[Tensor, "slices 11"]
    starts: Int64[Tensor, "slices 2"]
    scales: Float32[Tensor, "slices 2"]
    most: tuple[int, int]
    cells: int
    pixels: int

    def __len__(self) -> int:
        return len(self.places)

    @classmethod
    def of(cls, slices: Slices, tables: DeviceTables, most: float, whole: torch.dtype) -> "Batch":
        """Lay out slices one after the other. most: no light is stronger, without its sign. whole: numbers of sums."""
        places, starts, scales, cells, pixels = [], [], [], 0, 0
        for kind, number, box in slices.slices:
            least_px, largest_px = slices.range_px(number)
            exact, margin = tables.tables.exact, tables.tables.margin_px(largest_px)
            flags = (least_px < exact.to_px) + 2 * (largest_px > exact.from_px)
            window = box.within(slices.frame.grown(margin)).grown(margin)
            seen = window.within(slices.frame)
            unit = max(most, 1e-30) * tables.bound(least_px, largest_px) * tables.unit
            scale = 2.0 ** math.floor(_BITS[whole] - math.log2(unit))
            places.append((kind, number, *window, *seen, flags + 4 * margin))
            starts.append((cells, pixels))
            scales.append((scale, 1.0 / (scale * tables.unit)))
            cells, pixels = cells + window.rows * window.columns, pixels + seen.rows * seen.columns
        largest = max(place[4] for place in places), max(place[5] for place in places)
        of_numbers = (places, torch.int32), (starts, torch.int64), (scales, torch.float32)
        device = slices.values.device
        tensors = [torch.tensor(numbers, dtype=dtype).to(device) for numbers, dtype in of_numbers]
        return cls(slices, tensors[0], tensors[1], tensors[2], largest, cells, pixels)
