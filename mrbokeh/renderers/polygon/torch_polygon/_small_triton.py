"""Kernels for NVIDIA GPUs that spread light by whole small kernels: each place gathers what reaches it."""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float32
from torch import Tensor

from mrbokeh.renderers.polygon.torch_polygon._batch import Batch
from mrbokeh.renderers.polygon.torch_polygon._corners import REACH_PX, DeviceTables

_TILE = REACH_PX, REACH_PX
"""Rows and columns of the places that one program gathers; small kernels reach no farther than one tile."""


def spread_small(light: Float32[Tensor, "pixels 4"], batch: Batch, tables: DeviceTables) -> None:
    """Set the light of slices with small kernels to what goes by these."""
    if len(batch.small) == 0:
        return
    exact, slices, size = tables.tables.exact, batch.slices, tables.small.shape[2]
    _, height, width = slices.coc_px.shape
    planar = slices.values.permute(0, 3, 1, 2).contiguous()
    grid = (triton.cdiv(width, _TILE[1]), triton.cdiv(height, _TILE[0]), len(batch.small))
    reaches = torch.empty(grid[::-1], dtype=torch.int32, device=light.device)
    tensors = slices.coc_px, slices.shares, planar, batch.places, batch.small
    _reaches[grid](reaches, *tensors, height, width, slices.step_px, exact.to_px, 0.5 * exact.unit_radius, size // 2, *_TILE)
    sizes = height, width, tables.small.shape[1], size // 2, exact.per_px, slices.step_px
    shape = exact.from_px, 1.0 / (exact.to_px - exact.from_px), exact.to_px
    _spread_small[grid](light, *tensors, batch.starts, reaches, tables.small, *sizes, *shape, *_TILE)


@triton.jit
@no_type_check
def _reaches(
    reaches,
    coc_px,
    shares,
    planar,
    places,
    pieces,
    height,
    width,
    step_px,
    to_px,
    per_px,
    most,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    """Set for a tile and a slice how far its small kernels reach; -1 if there is none."""
    piece = tl.load(pieces + tl.program_id(2))
    kind, number = tl.load(places + 11 * piece), tl.load(places + 11 * piece + 1)
    layer = tl.minimum(kind, 1)
    y = tl.program_id(1) * ROWS + tl.arange(0, ROWS)
    x = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    inside = (y < height)[:, None] & (x < width)[None, :]
    at = y[:, None] * width + x[None, :]
    diameter = tl.load(coc_px + layer * height * width + at, mask=inside, other=0.0)
    light = tl.load(shares + kind * height * width + at, mask=inside, other=0.0)
    seen = tl.zeros((ROWS, COLUMNS), tl.float32)
    for channel in tl.static_range(0, 4):
        seen += tl.abs(tl.load(planar + (4 * layer + channel) * height * width + at, mask=inside, other=0.0))
    mine = inside & (light * seen > 0.0) & (tl.floor(diameter / step_px + 0.5) == number) & (tl.abs(diameter) < to_px)
    extent = tl.minimum(tl.ceil(tl.abs(diameter) * per_px + 0.5).to(tl.int32), most)
    extent = tl.where(tl.abs(diameter) <= 1.0, 0, extent)
    reach = tl.max(tl.max(tl.where(mine, extent, -1), axis=1), axis=0)
    tl.store(reaches + (tl.program_id(2) * tl.num_programs(1) + tl.program_id(1)) * tl.num_programs(0) + tl.program_id(0), reach)


@triton.jit
@no_type_check
def _spread_small(
    light,
    coc_px,
    shares,
    planar,
    places,
    pieces,
    starts,
    reaches,
    small,
    height,
    width,
    levels,
    radius,
    per_px,
    step_px,
    from_px,
    per_share,
    to_px,
    ROWS: tl.constexpr,
    COLUMNS: tl.constexpr,
):
    """Gather light of one slice for a tile, from as far around as small kernels there and in the tiles beside it reach."""
    piece, row, column = tl.load(pieces + tl.program_id(2)), tl.program_id(1), tl.program_id(0)
    place = places + 11 * piece
    top, left, rows, columns = tl.load(place + 6), tl.load(place + 7), tl.load(place + 8), tl.load(place + 9)
    y, x = row * ROWS + tl.arange(0, ROWS), column * COLUMNS + tl.arange(0, COLUMNS)
    mask = ((y >= top) & (y < top + rows))[:, None] & ((x >= left) & (x < left + columns))[None, :]
    if tl.max(tl.max(mask.to(tl.int32), axis=1), axis=0) > 0:
        reach = -1
        for above in tl.static_range(-1, 2):
            for aside in tl.static_range(-1, 2):
                ty, tx = row + above, column + aside
                there = (ty >= 0) & (ty < tl.num_programs(1)) & (tx >= 0) & (tx < tl.num_programs(0))
                tile = reaches + (tl.program_id(2) * tl.num_programs(1) + ty) * tl.num_programs(0) + tx
                reach = tl.maximum(reach, tl.load(tile, mask=there, other=-1))
        kind, number = tl.load(place), tl.load(place + 1)
        cells, size = height * width, 2 * radius + 1
        layer, of_kind = tl.minimum(kind, 1) * cells, kind * cells
        red, green = tl.zeros((ROWS, COLUMNS), tl.float32), tl.zeros((ROWS, COLUMNS), tl.float32)
        blue, alpha = tl.zeros((ROWS, COLUMNS), tl.float32), tl.zeros((ROWS, COLUMNS), tl.float32)
        for down in range(-reach, reach + 1):
            for right in range(-reach, reach + 1):
                sy, sx = y - down, x - right
                inside = ((sy >= 0) & (sy < height))[:, None] & ((sx >= 0) & (sx < width))[None, :]
                at = sy[:, None] * width + sx[None, :]
                diameter = tl.load(coc_px + layer + at, mask=inside, other=float("inf"))
                extent = tl.abs(diameter)
                used = inside & (extent < to_px) & (tl.floor(diameter / step_px + 0.5) == number)
                share = 1.0 - tl.minimum(tl.maximum((extent - from_px) * per_share, 0.0), 1.0)
                share = share * tl.load(shares + of_kind + at, mask=used, other=0.0)
                depth = (tl.minimum(tl.maximum(extent, 1.0), to_px) - 1.0) * per_px
                level = tl.minimum(depth.to(tl.int32), levels - 2)
                upper = depth - level.to(tl.float32)
                table = small + ((tl.where(diameter > 0.0, 0, levels) + level) * size + down + radius) * size + right + radius
                low = tl.load(table, mask=used, other=0.0)
                high = tl.load(table + size * size, mask=used, other=0.0)
                weight = share * (low + upper * (high - low))
                counts = used & (weight != 0.0)
                red += weight * tl.load(planar + 4 * layer + at, mask=counts, other=0.0)
                green += weight * tl.load(planar + 4 * layer + cells + at, mask=counts, other=0.0)
                blue += weight * tl.load(planar + 4 * layer + 2 * cells + at, mask=counts, other=0.0)
                alpha += weight * tl.load(planar + 4 * layer + 3 * cells + at, mask=counts, other=0.0)
        to = light + 4 * tl.load(starts + 2 * piece + 1) + ((y - top)[:, None] * columns + (x - left)[None, :]) * 4
        tl.store(to, red, mask=mask)
        tl.store(to + 1, green, mask=mask)
        tl.store(to + 2, blue, mask=mask)
        tl.store(to + 3, alpha, mask=mask)
