"""Kernels of polygonal differences for NVIDIA GPUs; imported only if triton is installed. `_loops` says what each computes.

All slices of a picture go together, each in a window of its own: one launch for all costs little more than one for the largest. Whole small
kernels spread light from the other side: each place gathers what reaches it.
"""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float32, Int
from torch import Tensor

from mrbokeh.layering.torch_layering.slicing import Slices
from mrbokeh.renderers.polygon._survey_numba import HIGHLIGHT
from mrbokeh.renderers.polygon.torch_polygon._batch import Batch, Group
from mrbokeh.renderers.polygon.torch_polygon._corners import REACH_PX, DeviceTables
from mrbokeh.renderers.polygon.torch_polygon._sums_triton import sum_along, sum_down

_TILE = REACH_PX, REACH_PX
"""Rows and columns of the places that one program gathers; small kernels reach no farther than one tile."""
Picture = Float32[Tensor, "height width 4"]
Plane = Float32[Tensor, "height width"]

_TILES_SEEN, _SPLATTED = 8, 32
"""Tiles that one program surveys; pixels that one splats, with a thread for each number, so that atomic additions lie side by side."""


def sum_slices(
    slices: Slices, kept: Plane | None, tables: DeviceTables, most: float, lowest: Float32[Tensor, "4"], whole: torch.dtype
) -> tuple[Float32[Tensor, "pixels 4"], Batch]:
    """Return the light of all slices, one after the other, and where each lies."""
    batch = Batch.of(slices, tables, most, whole)
    light = torch.empty((batch.pixels, 4), dtype=torch.float32, device=slices.values.device)
    spread_small(light, batch, tables)
    for group in batch.groups:
        planes = torch.zeros(group.cells * tables.planes * 4, dtype=whole, device=light.device)
        splat(planes, batch, group, kept, tables)
        sums = torch.empty(group.cells * len(tables.sums) * 4, dtype=whole, device=light.device)
        sum_along(sums, planes, batch, group, tables)
        sum_down(light, lowest, sums, batch, group, tables)
    return light, batch


def survey(values: Picture, coc_px: Plane) -> Float32[Tensor, "7"]:
    height, width = coc_px.shape
    grid = (triton.cdiv(width, 8 * _TILES_SEEN), triton.cdiv(height, 8))
    found = torch.empty((grid[1] * grid[0], 7), dtype=torch.float32, device=values.device)
    _survey[grid](found, values, coc_px, height, width, HIGHLIGHT, 8 * _TILES_SEEN)
    return found.amax(dim=0)


@triton.jit
@no_type_check
def _survey(found, values, coc_px, height, width, highlight, COLUMNS: tl.constexpr):
    """Survey a row of tiles of 8 x 8 pixels, mirrored at the end of the picture."""
    y, x = tl.program_id(1) * 8 + tl.arange(0, 8), tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    inside = (y < height)[:, None] & (x < width)[None, :]
    y = tl.where(y < height, y, tl.maximum(2 * height - 2 - y, 0))
    x = tl.where(x < width, x, tl.maximum(2 * width - 2 - x, 0))
    at = y[:, None] * width + x[None, :]
    size = tl.abs(tl.load(coc_px + at))
    size = tl.where(size == size, size, float("inf"))
    strongest, suspects = tl.zeros((8, COLUMNS), tl.float32), tl.zeros((8, COLUMNS // 8, 8), tl.int32)
    to = found + (tl.program_id(1) * tl.num_programs(0) + tl.program_id(0)) * 7
    for channel in tl.static_range(4):
        light = tl.load(values + at * 4 + channel)
        bright = tl.abs(light)
        strongest = tl.maximum(strongest, bright)
        tiles = tl.reshape(bright, (8, COLUMNS // 8, 8))
        total = tl.sum(tl.sum(tiles, axis=2), axis=0)
        suspects = tl.maximum(suspects, (tiles > highlight * total[None, :, None]).to(tl.int32))
        tl.store(to + 3 + channel, tl.maximum(tl.max(tl.max(-light, axis=1), axis=0), 0.0))
    strongest = tl.where(inside, strongest, 0.0)
    tl.store(to, tl.max(tl.max(strongest, axis=1), axis=0))
    tl.store(to + 1, tl.max(tl.max(tl.where(strongest > 0.0, size, 0.0), axis=1), axis=0))
    tl.store(to + 2, tl.max(tl.max(tl.max(suspects, axis=2), axis=1), axis=0).to(tl.float32))


def splat(planes: Int[Tensor, " numbers"], batch: Batch, group: Group, kept: Plane | None, tables: DeviceTables) -> None:
    """Add the impulses of all pixels to the planes of their slices. kept: the share of a pixel that is no highlight."""
    exact, corners, slices = tables.tables.exact, tables.tables.corners, batch.slices
    pixels = slices.coc_px[0].numel()
    grid = (triton.cdiv(pixels, _SPLATTED), len(slices.shares))
    tensors = planes, slices.values, slices.coc_px, slices.shares, slices.shares if kept is None else kept
    where = batch.places, batch.starts, batch.scales, slices.order
    sizes = pixels, slices.coc_px.shape[2], slices.first, slices.order.shape[1], slices.step_px
    shape = corners.growth, *corners.area, exact.from_px, 1.0 / (exact.to_px - exact.from_px)
    ends = group.first, group.end
    counts = len(tables.edges), len(tables.weights), tables.planes
    is_wide = planes.dtype == torch.int64
    of_tables = tables.edges, tables.corners, tables.weights
    _splat[grid](*tensors, *of_tables, *where, *sizes, *ends, *shape, *counts, is_wide, kept is not None, _SPLATTED, num_warps=4)


@triton.jit
@no_type_check
def _splat(
    planes,
    values,
    coc_px,
    shares,
    kept,
    edges,
    corners,
    weights,
    places,
    starts,
    scales,
    order,
    pixels,
    width,
    first,
    numbers,
    step_px,
    first_piece,
    end_piece,
    growth,
    area,
    area_offset,
    from_px,
    per_share,
    EDGES: tl.constexpr,
    CORNERS: tl.constexpr,
    PLANES: tl.constexpr,
    IS_WIDE: tl.constexpr,
    HAS_KEPT: tl.constexpr,
    PIXELS: tl.constexpr,
):
    """Splat pixels of one kind, each into the planes of its slice."""
    kind = tl.program_id(1)
    layer = tl.minimum(kind, 1) * pixels
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = pixel < pixels
    diameter = tl.load(coc_px + layer + pixel, mask=inside, other=0.0)
    gain = tl.minimum(tl.maximum((tl.abs(diameter) - from_px) * per_share, 0.0), 1.0)
    gain = gain * tl.load(shares + kind * pixels + pixel, mask=inside, other=0.0)
    if HAS_KEPT:
        gain = gain * tl.load(kept + pixel, mask=inside & (0 * pixel + kind == 0), other=1.0)
    if tl.max(gain, axis=0) > 0.0:
        number = tl.floor(diameter / step_px + 0.5).to(tl.int32) - first
        piece = tl.load(order + kind * numbers + number, mask=(gain > 0.0) & (number >= 0) & (number < numbers), other=-1)
        used = (piece >= first_piece) & (piece < end_piece)
        piece = tl.where(used, piece, 0)
        place = places + piece * 11
        rows, columns = tl.load(place + 4, mask=used, other=1), tl.load(place + 5, mask=used, other=1)
        y, x = pixel // width - tl.load(place + 2, mask=used, other=0), pixel % width - tl.load(place + 3, mask=used, other=0)
        sense = tl.where(diameter > 0.0, 1.0, -1.0)
        r = sense * tl.sqrt(0.25 * diameter * diameter + growth)
        flags = tl.load(place + 10, mask=used, other=0)
        margin, used = flags // 8, used & (flags // 2 % 2 == 1)
        used = used & (y >= margin) & (y < rows - margin) & (x >= margin) & (x < columns - margin)
        channel = tl.arange(0, 4)
        at = (layer + pixel)[:, None] * 4 + channel[None, :]
        light = tl.load(values + at, mask=used[:, None] & (channel < 4)[None, :], other=0.0)
        lit = light != 0.0
        whole = area * r * r + area_offset
        for edge in range(EDGES):
            offset = tl.load(edges + 4 * edge) * r + (tl.load(edges + 4 * edge + 2) + sense * tl.load(edges + 4 * edge + 1))
            part = offset - tl.floor(offset)
            whole += tl.load(edges + 4 * edge + 3) * part * (1.0 - part)
        scale = tl.load(scales + 2 * piece, mask=used, other=0.0)
        light = light * (gain / whole)[:, None]
        light = light.to(tl.float64) * scale[:, None].to(tl.float64) if IS_WIDE else light * scale[:, None]
        cells = rows * columns
        here = tl.load(starts + 2 * piece, mask=used, other=0) * PLANES + y * columns + x
        for corner in range(CORNERS):
            row = corners + 7 * corner
            before, after = edges + 4 * tl.load(row), edges + 4 * tl.load(row + 1)
            offset_before = tl.load(before) * r + (tl.load(before + 2) + sense * tl.load(before + 1))
            offset_after = tl.load(after) * r + (tl.load(after + 2) + sense * tl.load(after + 1))
            line, line_after = tl.floor(offset_before), tl.floor(offset_after)
            share, share_after = offset_before - line, offset_after - line_after
            step = tl.load(row + 3) * columns + tl.load(row + 2)
            step_after = tl.load(row + 5) * columns + tl.load(row + 4)
            cell = here + (tl.load(row + 6) * cells + line.to(tl.int32) * step + line_after.to(tl.int32) * step_after)
            to = planes + cell[:, None] * 4 + channel[None, :]
            sign = tl.load(weights + corner)
            _add(to, light, sign * (1.0 - share) * (1.0 - share_after), lit, IS_WIDE)
            _add(to + 4 * step_after[:, None], light, sign * (1.0 - share) * share_after, lit, IS_WIDE)
            _add(to + 4 * step[:, None], light, sign * share * (1.0 - share_after), lit, IS_WIDE)
            _add(to + 4 * (step + step_after)[:, None], light, sign * share * share_after, lit, IS_WIDE)


@triton.jit
@no_type_check
def _add(to, light, weight, mask, IS_WIDE: tl.constexpr):
    if IS_WIDE:
        impulse = tl.floor(light * weight[:, None].to(tl.float64) + 0.5).to(tl.int64)
    else:
        impulse = tl.floor(light * weight[:, None] + 0.5).to(tl.int32)
    tl.atomic_add(to, impulse, mask=mask, sem="relaxed")


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
