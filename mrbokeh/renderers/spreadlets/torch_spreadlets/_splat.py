"""Splatting on a device: every pixel adds its light times the points of its cell, in whole numbers."""

import math
from collections.abc import Sequence

import torch
from jaxtyping import Float32, Float64, Int32, Int64
from torch import Tensor

from mrbokeh.renderers.spreadlets.layout import Window
from mrbokeh.renderers.spreadlets.torch_spreadlets._points import PointTable
from mrbokeh.system.errors import InputError
from mrbokeh.system.torch_device import has_triton

AT_ONCE = {"cpu": 1 << 14, "cuda": 1 << 21}
"""Points that are splatted at a time without a kernel: what caches hold, or what keeps a GPU busy with some 400 MB."""
_BITS = 61
_MOST_NUMBERED = 1 << 31  # the kernel counts in 32 bits

Light = Float32[Tensor, "height width channels"]
Cells = Int32[Tensor, "height width"]


def splat(
    values: Light, cells: Cells, table: PointTable, window: Window, largest: float, colours: Sequence[int] = ()
) -> Float64[Tensor, "channels rows columns"]:
    """The sums over all pixels with a cell (>= 0) within a window that all points fall into. Same bits on every device.

    largest: no value is larger, without its sign. colours: the column of weights that each channel takes; () is the first.
    """
    if not math.isfinite(largest):
        raise InputError(f"light must be finite, but the brightest pixel is {largest}: clean the picture of inf and NaN")
    bound = max(largest * table.largest_sum, 1e-200)
    exponent = _BITS - math.frexp(bound)[1]
    sums = torch.zeros((window.height, window.width, values.shape[2]), dtype=torch.int64, device=values.device)
    task = sums, values, cells, table, window, math.ldexp(1.0, exponent), colours or (0,) * values.shape[2]
    if values.device.type == "cuda" and has_triton() and sums.numel() < _MOST_NUMBERED:
        from mrbokeh.renderers.spreadlets.torch_spreadlets._splat_triton import splat_by_kernel

        splat_by_kernel(*task)
    else:
        splat_in_chunks(*task)
    return sums.permute(2, 0, 1).to(torch.float64, memory_format=torch.contiguous_format).mul_(math.ldexp(1.0, -exponent))


def splat_in_chunks(
    sums: Int64[Tensor, "rows columns channels"],
    values: Light,
    cells: Cells,
    table: PointTable,
    window: Window,
    scale: float,
    colours: Sequence[int],
    at_once: int = 0,
) -> None:
    """Add round(scale * weight * light) to sums: all points of some pixels at a time, wherever torch runs."""
    channels = torch.arange(values.shape[2], device=values.device)
    pixels = torch.nonzero(cells.reshape(-1) >= 0)[:, 0]
    cell = cells.reshape(-1)[pixels].long()
    count, first = table.count.long()[cell], table.first.long()[cell]
    light = values.reshape(-1, len(channels))[pixels].double()
    base = (pixels // cells.shape[1] - window.top) * window.width + pixels % cells.shape[1] - window.left
    shift, weights = table.xy[:, 1].long() * window.width + table.xy[:, 0], table.weights * scale
    ends = torch.cumsum(count, 0)
    for begin, end in _chunks(ends.cpu(), at_once or AT_ONCE[values.device.type]):
        who = torch.repeat_interleave(count[begin:end]) + begin
        point = torch.arange(len(who), device=who.device) + (first - ends + count)[who] + (ends - count)[begin]
        weight = weights[point] if weights.shape[1] == 1 else weights[point][:, list(colours)]
        target = (base[who] + shift[point])[:, None] * len(channels) + channels
        sums.view(-1).index_add_(0, target.view(-1), rounded(light[who] * weight).view(-1))


def rounded(number: Float64[Tensor, "*batch"]) -> Int64[Tensor, "*batch"]:
    """The nearest whole number, halves upwards; the kernel does the same."""
    return torch.floor(number + 0.5).to(torch.int64)


def _chunks(ends: Int64[Tensor, " pixels"], at_once: int) -> list[tuple[int, int]]:
    """First and end of runs of pixels with at most so many points together, or of single pixels."""
    chunks, begin, before = [], 0, 0
    while begin < len(ends):
        end = max(int(torch.searchsorted(ends, before + at_once, right=True)), begin + 1)
        chunks.append((begin, end))
        begin, before = end, int(ends[end - 1])
    return chunks
