"""Kernels of polygonal differences for NVIDIA GPUs; imported only if triton is installed. `_loops` says what each computes."""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float32, Int
from torch import Tensor

from mrbokeh.renderers.polygon.torch_polygon._corners import Along, DeviceTables

Planes = Int[Tensor, "planes rows columns 4"]
Picture = Float32[Tensor, "height width 4"]
Plane = Float32[Tensor, "height width"]

_PIXELS = 128
"""Pixels that one program splats."""
_CHAINS, _CELLS, _ROWS = 32, 64, 64
"""Sums that a program advances together: chains along a direction, cells of a row, and rows of a column."""


def splat(planes: Planes, values: Picture, radius: Plane, gain: Plane, tables: DeviceTables, scale: float, margin: int) -> None:
    height, width = gain.shape
    area = tables.tables.corners.area
    grid = (triton.cdiv(gain.numel(), _PIXELS),)
    tensors = planes, values, radius, gain, tables.edges, tables.corners, tables.weights
    sizes = gain.numel(), width, planes.shape[1] * planes.shape[2], planes.shape[2], margin
    counts = len(tables.edges), len(tables.weights)
    _splat[grid](*tensors, *sizes, area[0], area[1], scale, *counts, planes.dtype == torch.int64, _PIXELS)


@triton.jit
@no_type_check
def _splat(
    planes,
    values,
    radius,
    gain,
    edges,
    corners,
    weights,
    pixels,
    width,
    cells,
    columns,
    margin,
    area,
    area_offset,
    scale,
    EDGES: tl.constexpr,
    CORNERS: tl.constexpr,
    IS_WIDE: tl.constexpr,
    PIXELS: tl.constexpr,
):
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    share = tl.load(gain + pixel, mask=pixel < pixels, other=0.0)
    lit = share > 0.0
    if tl.max(share, axis=0) > 0.0:
        r = tl.load(radius + pixel, mask=lit, other=1.0)
        sense = tl.where(r > 0.0, 1.0, -1.0)
        whole = area * r * r + area_offset
        for edge in range(EDGES):
            offset = tl.load(edges + 4 * edge) * r + (tl.load(edges + 4 * edge + 2) + sense * tl.load(edges + 4 * edge + 1))
            part = offset - tl.floor(offset)
            whole += tl.load(edges + 4 * edge + 3) * part * (1.0 - part)
        channel = tl.arange(0, 4)
        both = lit[:, None] & (channel < 4)[None, :]
        light = tl.load(values + pixel[:, None] * 4 + channel[None, :], mask=both, other=0.0) * (share / whole)[:, None]
        if IS_WIDE:
            light = light.to(tl.float64) * scale
        else:
            light = light * scale
        here = (pixel // width + margin) * columns + pixel % width + margin
        for corner in range(CORNERS):
            row = corners + 7 * corner
            before, after = edges + 4 * tl.load(row), edges + 4 * tl.load(row + 1)
            offset = tl.load(before) * r + (tl.load(before + 2) + sense * tl.load(before + 1))
            offset_after = tl.load(after) * r + (tl.load(after + 2) + sense * tl.load(after + 1))
            line, line_after = tl.floor(offset), tl.floor(offset_after)
            part, part_after = offset - line, offset_after - line_after
            step = tl.load(row + 3) * columns + tl.load(row + 2)
            step_after = tl.load(row + 5) * columns + tl.load(row + 4)
            place = here + line.to(tl.int32) * step + line_after.to(tl.int32) * step_after
            to = planes + (tl.load(row + 6) * cells + place)[:, None] * 4 + channel[None, :]
            sign = tl.load(weights + corner)
            _add(to, light, sign * (1.0 - part) * (1.0 - part_after), both, IS_WIDE)
            _add(to + 4 * step_after, light, sign * (1.0 - part) * part_after, both, IS_WIDE)
            _add(to + 4 * step, light, sign * part * (1.0 - part_after), both, IS_WIDE)
            _add(to + 4 * (step + step_after), light, sign * part * part_after, both, IS_WIDE)


@triton.jit
@no_type_check
def _add(to, light, weight, mask, IS_WIDE: tl.constexpr):
    if IS_WIDE:
        impulse = tl.floor(light * weight[:, None].to(tl.float64) + 0.5).to(tl.int64)
    else:
        impulse = tl.floor(light * weight[:, None] + 0.5).to(tl.int32)
    tl.atomic_add(to, impulse, mask=mask, sem="relaxed")


def sum_along(planes: Planes, along: Along) -> Int[Tensor, "rows columns 4"]:
    _, rows, columns, _ = planes.shape
    out = torch.empty_like(planes[0])
    dx, dy = along.step
    inputs = _inputs(planes, along)
    if dy == 0:
        _sum_rows[(rows,)](out, planes, *inputs, columns, len(along.inputs), _CELLS)
        return out
    steps = triton.cdiv(rows, dy)
    chains = columns + abs(dx) * (steps - 1)
    grid = (triton.cdiv(chains, _CHAINS), dy)
    _sum_chains[grid](out, planes, *inputs, rows, columns, steps, dx, dy, len(along.inputs), _CHAINS)
    return out


def _inputs(planes: Planes, along: Along) -> list[int]:
    """Return places of up to four planes and their signs, filled up with the first."""
    cells = planes.shape[1] * planes.shape[2] * 4
    places, signs = [plane * cells for plane, _ in along.inputs], [sign for _, sign in along.inputs]
    missing = 4 - len(places)
    return [*places, *[0] * missing, *signs, *[0] * missing]


@triton.jit
@no_type_check
def _fed(planes, at, mask, p0, p1, p2, p3, s0, s1, s2, s3, INPUTS: tl.constexpr):
    """Return what the planes feed to a sum at some cells."""
    total = s0 * tl.load(planes + p0 + at, mask=mask, other=0)
    if INPUTS > 1:
        total += s1 * tl.load(planes + p1 + at, mask=mask, other=0)
    if INPUTS > 2:
        total += s2 * tl.load(planes + p2 + at, mask=mask, other=0)
    if INPUTS > 3:
        total += s3 * tl.load(planes + p3 + at, mask=mask, other=0)
    return total


@triton.jit
@no_type_check
def _sum_rows(out, planes, p0, p1, p2, p3, s0, s1, s2, s3, columns, INPUTS: tl.constexpr, CELLS: tl.constexpr):
    row = tl.program_id(0) * columns
    channel = tl.arange(0, 4)
    carry = tl.zeros((4,), out.dtype.element_ty)
    for left in range(0, columns, CELLS):
        x = left + tl.arange(0, CELLS)
        at = (row + x)[:, None] * 4 + channel[None, :]
        mask = (x < columns)[:, None] & (channel < 4)[None, :]
        fed = _fed(planes, at, mask, p0, p1, p2, p3, s0, s1, s2, s3, INPUTS)
        tl.store(out + at, tl.cumsum(fed, axis=0) + carry[None, :], mask=mask)
        carry += tl.sum(fed, axis=0)


@triton.jit
@no_type_check
def _sum_chains(
    out,
    planes,
    p0,
    p1,
    p2,
    p3,
    s0,
    s1,
    s2,
    s3,
    rows,
    columns,
    steps,
    dx,
    dy,
    INPUTS: tl.constexpr,
    CHAINS: tl.constexpr,
):
    """Advance neighbouring chains, each a step (dx, dy) at a time, as long as any of them is in the picture."""
    first = tl.program_id(0) * CHAINS
    channel = tl.arange(0, 4)
    mine = (rows - tl.program_id(1) + dy - 1) // dy
    if dx > 0:
        first -= dx * (steps - 1)
        begin = tl.maximum(-first - CHAINS + dx, 0) // dx
        end = tl.minimum(mine, (columns - 1 - first) // dx + 1)
    else:
        begin = tl.maximum(first - columns - dx, 0) // (-dx)
        end = tl.minimum(mine, (first + CHAINS - 1) // (-dx) + 1)
    carry = tl.zeros((CHAINS, 4), out.dtype.element_ty)
    for j in range(begin, end):
        x, y = first + tl.arange(0, CHAINS) + j * dx, tl.program_id(1) + j * dy
        mask = ((x >= 0) & (x < columns))[:, None] & (channel < 4)[None, :]
        at = (y * columns + x)[:, None] * 4 + channel[None, :]
        carry += _fed(planes, at, mask, p0, p1, p2, p3, s0, s1, s2, s3, INPUTS)
        tl.store(out + at, carry, mask=mask)


def sum_down(sums: Int[Tensor, "directions rows columns 4"], tables: DeviceTables, unit: float, margin: int) -> Picture:
    _, rows, columns, _ = sums.shape
    height, width = rows - 2 * margin, columns - 2 * margin
    places, weights = _profiles(sums, tables)
    chunks = triton.cdiv(rows - margin, _ROWS)
    before = torch.empty((chunks, width, 4), dtype=sums.dtype, device=sums.device)
    out = torch.empty((height, width, 4), dtype=torch.float32, device=sums.device)
    grid = (triton.cdiv(width, _CELLS), chunks)
    sizes = rows - margin, columns, width, margin, unit
    _sum_columns[grid](out, before, sums, places, weights, *sizes, len(places), False, _CELLS, _ROWS)
    before = before.cumsum(dim=0, dtype=sums.dtype) - before
    _sum_columns[grid](out, before, sums, places, weights, *sizes, len(places), True, _CELLS, _ROWS)
    return out


def _profiles(sums: Int[Tensor, "directions rows columns 4"], tables: DeviceTables) -> tuple[Tensor, Tensor]:
    """Return (taps, 2): how many elements back and how many rows back each tap of the profiles looks, and (taps,) its weight."""
    _, rows, columns, _ = sums.shape
    places, weights = [], []
    for d, along in enumerate(tables.sums):
        for x, y, weight in along.taps:
            places.append((4 * (d * rows * columns - y * columns - x), y))
            weights.append(weight)
    device = sums.device
    return torch.tensor(places, dtype=torch.int32, device=device), torch.tensor(weights, dtype=torch.int32, device=device)


@triton.jit
@no_type_check
def _sum_columns(
    out,
    before,
    sums,
    places,
    weights,
    rows,
    columns,
    width,
    margin,
    unit,
    TAPS: tl.constexpr,
    IS_LAST: tl.constexpr,
    CELLS: tl.constexpr,
    ROWS: tl.constexpr,
):
    """Sum profiles over the rows of one chunk: into `before`, or on from there into the picture."""
    x = tl.program_id(0) * CELLS + tl.arange(0, CELLS)
    channel = tl.arange(0, 4)
    mask = (x < width)[:, None] & (channel < 4)[None, :]
    chunk = (tl.program_id(1) * width + x)[:, None] * 4 + channel[None, :]
    total = tl.zeros((CELLS, 4), sums.dtype.element_ty)
    if IS_LAST:
        total = tl.load(before + chunk, mask=mask, other=0)
    top = tl.program_id(1) * ROWS
    for y in range(top, tl.minimum(top + ROWS, rows)):
        at = (y * columns + margin + x)[:, None] * 4 + channel[None, :]
        for tap in tl.static_range(TAPS):
            back = tl.load(places + 2 * tap + 1)
            total += tl.load(weights + tap) * tl.load(
                sums + at + tl.load(places + 2 * tap), mask=mask & (0 * x + y >= back)[:, None], other=0
            )
        if IS_LAST:
            if y >= margin:
                to = ((y - margin) * width + x)[:, None] * 4 + channel[None, :]
                tl.store(out + to, (total.to(tl.float64) * unit).to(tl.float32), mask=mask)
    if not IS_LAST:
        tl.store(before + chunk, total, mask=mask)


def spread_small(values: Picture, coc_px: Plane, share: Plane, tables: DeviceTables) -> Picture:
    height, width, _ = values.shape
    out = torch.empty_like(values)
    exact, size = tables.tables.exact, tables.small.shape[2]
    sizes = height, width, tables.small.shape[1], size // 2, exact.per_px, exact.to_px
    grid = (triton.cdiv(width, _TILE[1]), triton.cdiv(height, _TILE[0]))
    _spread_small[grid](out, values, coc_px, share, tables.small, *sizes, *_TILE)
    return out


_TILE = 8, 16
"""Rows and columns of the places that one program gathers."""


@triton.jit
@no_type_check
def _spread_small(
    out, values, coc_px, share, small, height, width, levels, reach, per_px, to_px, ROWS: tl.constexpr, COLUMNS: tl.constexpr
):
    """Gather light for a tile, from as far around as the largest small kernel there reaches."""
    y = tl.program_id(1) * ROWS + tl.arange(0, ROWS)
    x = tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    channel = tl.arange(0, 4)
    size = 2 * reach + 1
    light = tl.zeros((ROWS, COLUMNS, 4), tl.float32)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            sy, sx = y - dy, x - dx
            inside = ((sy >= 0) & (sy < height))[:, None] & ((sx >= 0) & (sx < width))[None, :]
            at = sy[:, None] * width + sx[None, :]
            part = tl.load(share + at, mask=inside, other=0.0)
            used = part > 0.0
            diameter = tl.load(coc_px + at, mask=used, other=1.0)
            place = (tl.minimum(tl.maximum(tl.abs(diameter), 1.0), to_px) - 1.0) * per_px
            level = tl.minimum(place.to(tl.int32), levels - 2)
            upper = place - level.to(tl.float32)
            table = small + ((tl.where(diameter > 0.0, 0, levels) + level) * size + dy + reach) * size + dx + reach
            low = tl.load(table, mask=used, other=0.0)
            high = tl.load(table + size * size, mask=used, other=0.0)
            weight = part * (low + upper * (high - low))
            here = tl.load(
                values + at[:, :, None] * 4 + channel[None, None, :], mask=used[:, :, None] & (channel < 4)[None, None, :], other=0.0
            )
            light += weight[:, :, None] * here
    to = (y[:, None] * width + x[None, :])[:, :, None] * 4 + channel[None, None, :]
    mask = ((y < height)[:, None] & (x < width)[None, :])[:, :, None] & (channel < 4)[None, None, :]
    tl.store(out + to, light, mask=mask)
