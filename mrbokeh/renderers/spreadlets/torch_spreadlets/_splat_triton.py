"""Splatting as one kernel with atomic additions, for NVIDIA GPUs; imported only if triton is installed."""

from collections.abc import Sequence
from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float32, Int32, Int64
from torch import Tensor

from mrbokeh.renderers.spreadlets.sums import Window
from mrbokeh.renderers.spreadlets.torch_spreadlets._kernels import PointTable

_PIXELS, _SEGMENT = 64, 128
"""Pixels of a program, side by side, and points that it splats of each: a lamp's thousands are shared between programs."""


def splat_by_kernel(
    sums: Int64[Tensor, "rows columns channels"],
    values: Float32[Tensor, "height width channels"],
    cells: Int32[Tensor, "height width"],
    table: PointTable,
    window: Window,
    scale: float,
    colours: Sequence[int],
) -> None:
    """Splat as `splat_in_chunks` does, to the same bits."""
    channels, columns = values.shape[2], table.weights.shape[1]
    shift = table.xy[:, 1] * window.width + table.xy[:, 0]
    corner = -window.top * window.width - window.left
    grid = (triton.cdiv(cells.numel(), _PIXELS), triton.cdiv(table.most, _SEGMENT))
    tensors = sums, values.contiguous(), cells.contiguous(), table.first, table.count, shift.to(torch.int32), table.weights * scale
    column_of = torch.tensor(colours, dtype=torch.int32, device=values.device)
    sizes = cells.numel(), cells.shape[1], window.width, corner
    wide = triton.next_power_of_2(channels)
    with torch.cuda.device_of(values):
        _splat[grid](*tensors, column_of, *sizes, channels, columns, wide, _PIXELS, _SEGMENT, enable_fp_fusion=False)


@triton.jit
@no_type_check
def _splat(
    sums,
    values,
    cells,
    first,
    count,
    shift,
    weights,
    column_of,
    pixels,
    width,
    window_width,
    corner,
    CHANNELS: tl.constexpr,
    COLUMNS: tl.constexpr,
    WIDE: tl.constexpr,
    PIXELS: tl.constexpr,
    SEGMENT: tl.constexpr,
):
    """Splat PIXELS pixels, SEGMENT points of each, in one program. Neighbours mostly share a cell, so that they read the same points and
    write side by side.
    """
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    begin = tl.program_id(1) * SEGMENT
    cell = tl.load(cells + pixel, mask=pixel < pixels, other=-1)
    left = tl.load(count + cell, mask=cell >= 0, other=0) - begin
    most = tl.minimum(tl.max(left, axis=0), SEGMENT)
    if most > 0:
        channel = tl.arange(0, WIDE)
        is_channel = channel < CHANNELS
        lit = (left > 0)[:, None] & is_channel[None, :]
        light = tl.load(values + pixel[:, None] * CHANNELS + channel[None, :], mask=lit, other=0.0).to(tl.float64)
        point = tl.load(first + cell, mask=left > 0, other=0) + begin
        base = pixel // width * window_width + pixel % width + corner
        column = tl.load(column_of + channel, mask=is_channel, other=0)
        for k in range(most):
            here = k < left
            both = here[:, None] & is_channel[None, :]
            place = base + tl.load(shift + point + k, mask=here, other=0)
            if COLUMNS == 1:
                weight = tl.load(weights + point + k, mask=here, other=0.0)[:, None]
            else:
                weight = tl.load(weights + (point + k)[:, None] * COLUMNS + column[None, :], mask=both, other=0.0)
            whole = tl.floor(weight * light + 0.5).to(tl.int64)
            tl.atomic_add(sums + place[:, None] * CHANNELS + channel[None, :], whole, mask=both, sem="relaxed")
