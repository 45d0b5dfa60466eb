"""Slices laid out one after the other in the memory of a device."""

import math
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float32, Int32, Int64
from torch import Tensor

from mrbokeh.layering.torch_layering.slicing import Slices
from mrbokeh.renderers.polygon.torch_polygon._corners import DeviceTables
from mrbokeh.system.errors import InputError

_BITS = {torch.int32: 31, torch.int64: 62}


@dataclass(frozen=True)
class Batch:
    """Slices with their windows on the device.

    places (S, 11), whole numbers: kind, number, window (top, left, rows, columns), the part of it that lies in the frame (the same four);
    last 1 where whole small kernels are needed, 2 where sums are, 4 if it joins the slice before, and 8 times the margin of the window,
    which holds no pixels. starts (S, 2): of the window, in cells, and of its visible part, in pixels, where they lie one after the other.
    scales (S, 2): units of one in the sums, and what one of them means in the picture. small, groups: numbers of the slices with small
    kernels, and of those with sums, as many together as fit the memory. host: the places once more.
    """

    slices: Slices
    places: Int32[Tensor, "slices 11"]
    starts: Int64[Tensor, "slices 2"]
    scales: Float32[Tensor, "slices 2"]
    small: Int32[Tensor, " _"]
    groups: list["Group"]
    pixels: int
    host: list[tuple[int, ...]]

    @classmethod
    def of(cls, slices: Slices, tables: DeviceTables, most: float, whole: torch.dtype) -> "Batch":
        """Lay out slices one after the other. most: no light is stronger, without its sign. whole: numbers of sums."""
        exact, device = tables.tables.exact, slices.values.device
        places: list[tuple[int, ...]] = []
        starts, scales, pixels = [], [], 0
        most_cells = _cells_at_once(device, (tables.planes + len(tables.sums)) * 4 * whole.itemsize)
        waiting: list[list[int]] = []
        cells = 0
        for number, each in enumerate(slices.slices):
            least_px, largest_px = slices.range_px(each.number)
            margin, is_summed = tables.tables.margin_px(largest_px), largest_px > exact.from_px
            window = each.box.within(slices.frame.grown(margin)).grown(margin)
            if 4 * window.rows * window.columns * max(tables.planes, len(tables.sums)) >= 1 << 31:
                raise InputError(
                    f"a picture of {slices.frame.columns}x{slices.frame.rows} px with circles of confusion of up to {largest_px:.0f} px is "
                    f"too large for the device: leave the device out, or render it smaller"
                )
            seen = window.within(slices.frame)
            unit = max(most, 1e-30) * tables.bound(least_px, largest_px) * tables.unit
            scale = 2.0 ** math.floor(_BITS[whole] - math.log2(unit))
            if is_summed and (not waiting or cells + window.rows * window.columns > most_cells):
                waiting.append([])
                cells = 0
            places.append((each.kind, each.number, *window, *seen, (least_px < exact.to_px) + 2 * is_summed + 4 * each.joins + 8 * margin))
            starts.append((cells, pixels))
            scales.append((scale, 1.0 / (scale * tables.unit)))
            pixels += seen.rows * seen.columns
            if is_summed:
                waiting[-1].append(number)
                cells += window.rows * window.columns
        sent = _sent(places, torch.int32, device), _sent(starts, torch.int64, device), _sent(scales, torch.float32, device)
        small = _sent([number for number, place in enumerate(places) if place[10] % 2], torch.int32, device)
        groups = [Group.of(numbers, places, device) for numbers in waiting]
        return cls(slices, *sent, small, groups, pixels, places)


@dataclass(frozen=True)
class Group:
    """Slices whose sums are in memory together: their numbers, the rows and columns of the largest window, the cells of all, and between
    which numbers they lie.
    """

    numbers: Int32[Tensor, " _"]
    most: tuple[int, int]
    cells: int
    first: int
    end: int

    @classmethod
    def of(cls, numbers: list[int], places: list[tuple[int, ...]], device: torch.device) -> "Group":
        sizes = [places[number][4:6] for number in numbers]
        most = max(rows for rows, _ in sizes), max(columns for _, columns in sizes)
        return cls(_sent(numbers, torch.int32, device), most, sum(rows * columns for rows, columns in sizes), numbers[0], numbers[-1] + 1)


def _sent(numbers: list[Any], dtype: torch.dtype, device: torch.device) -> Tensor:
    return torch.tensor(numbers, dtype=dtype).to(device, non_blocking=True)


def _cells_at_once(device: torch.device, bytes_per_cell: int) -> int:
    """Return how many cells an eighth of the device's memory holds, but no more than kernels count in 32 bits."""
    memory = torch.cuda.get_device_properties(device).total_memory if device.type == "cuda" else 8 << 30
    return min(memory // 8, 1 << 33) // bytes_per_cell
