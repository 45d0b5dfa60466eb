"""Kernels for NVIDIA GPUs that sum impulses along directions and downwards, all slices of a picture at a time.

A row is a line of numbers, four channels of a cell side by side, of which neighbouring threads take neighbouring ones.
"""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float32, Int
from torch import Tensor

from mrbokeh.renderers.polygon.torch_polygon._batch import Batch, Group
from mrbokeh.renderers.polygon.torch_polygon._corners import DeviceTables

_CHAIN_STEPS, _CHAIN_NUMBERS = 16, 64
_COLUMN_ROWS, _COLUMN_STEPS, _COLUMN_NUMBERS = 64, 8, 64
"""Rows of a chunk, and what a program of one warp loads at a time."""
_ROW_CELLS = 64


def sum_along(sums: Int[Tensor, " numbers"], planes: Int[Tensor, " numbers"], batch: Batch, group: Group, tables: DeviceTables) -> None:
    """Set the sums of every slice along all directions."""
    (rows, columns), pieces, side = group.most, len(group.numbers), _CHAIN_NUMBERS // 4
    tensors = sums, planes, batch.places, batch.starts, group.numbers, tables.directions
    counts = tables.planes, len(tables.sums), max(len(along.inputs) for along in tables.sums)
    slanted = [along.step for along in tables.sums if along.step[1]]
    if slanted:
        chains = max(columns + abs(dx) * (triton.cdiv(rows, dy) - 1) for dx, dy in slanted)
        grid = (triton.cdiv(chains, side), max(dy for _, dy in slanted), pieces * len(tables.sums))
        _sum_chains[grid](*tensors, *counts, _CHAIN_STEPS, _CHAIN_NUMBERS, num_warps=1)
    for which, along in enumerate(tables.sums):
        if along.step[1] == 0:
            _sum_rows[(rows, pieces)](*tensors, which, *counts, _ROW_CELLS)


@triton.jit
@no_type_check
def _fed(planes, cells, at, mask, direction, INPUTS: tl.constexpr):
    """Return what the planes feed to a sum. cells: numbers of one plane. direction: dx, dy, then each plane and its sign."""
    total = tl.load(direction + 3) * tl.load(planes + tl.load(direction + 2) * cells + at, mask=mask, other=0)
    for k in tl.static_range(1, INPUTS):
        total += tl.load(direction + 3 + 2 * k) * tl.load(planes + tl.load(direction + 2 + 2 * k) * cells + at, mask=mask, other=0)
    return total


@triton.jit
@no_type_check
def _sum_rows(
    sums,
    planes,
    places,
    starts,
    numbers,
    directions,
    which,
    PLANES: tl.constexpr,
    SUMS: tl.constexpr,
    INPUTS: tl.constexpr,
    CELLS: tl.constexpr,
):
    piece = tl.load(numbers + tl.program_id(1))
    rows, columns = tl.load(places + 11 * piece + 4), tl.load(places + 11 * piece + 5)
    if tl.program_id(0) < rows:
        start, cells = 4 * tl.load(starts + 2 * piece), 4 * rows * columns
        source, out = planes + start * PLANES, sums + start * SUMS + which * cells
        direction = directions + (2 + 2 * INPUTS) * which
        channel = tl.arange(0, 4)
        carry = tl.zeros((4,), sums.dtype.element_ty)
        for left in range(0, columns, CELLS):
            x = left + tl.arange(0, CELLS)
            at = (tl.program_id(0) * columns + x)[:, None] * 4 + channel[None, :]
            mask = (x < columns)[:, None] & (channel < 4)[None, :]
            fed = _fed(source, cells, at, mask, direction, INPUTS)
            tl.store(out + at, tl.cumsum(fed, axis=0) + carry[None, :], mask=mask)
            carry += tl.sum(fed, axis=0)


@triton.jit
@no_type_check
def _sum_chains(
    sums,
    planes,
    places,
    starts,
    numbers,
    directions,
    PLANES: tl.constexpr,
    SUMS: tl.constexpr,
    INPUTS: tl.constexpr,
    STEPS: tl.constexpr,
    NUMBERS: tl.constexpr,
):
    """Advance neighbouring chains by steps of (dx, dy), as long as any of them is in the window; several steps are loaded at a time."""
    which = tl.program_id(2) % SUMS
    piece = tl.load(numbers + tl.program_id(2) // SUMS)
    direction = directions + (2 + 2 * INPUTS) * which
    dx, dy = tl.load(direction), tl.load(direction + 1)
    rows, columns = tl.load(places + 11 * piece + 4), tl.load(places + 11 * piece + 5)
    if tl.program_id(1) < dy:
        start, cells = 4 * tl.load(starts + 2 * piece), 4 * rows * columns
        source, out = planes + start * PLANES, sums + start * SUMS + which * cells
        first = tl.program_id(0) * (NUMBERS // 4)
        mine = (rows - tl.program_id(1) + dy - 1) // dy
        if dx > 0:
            first -= dx * ((rows + dy - 1) // dy - 1)
            begin = tl.maximum(-first - NUMBERS // 4 + dx, 0) // dx
            end = tl.minimum(mine, tl.maximum(columns - 1 - first + dx, 0) // dx)
        else:
            begin = tl.maximum(first - columns - dx, 0) // (-dx)
            end = tl.minimum(mine, (first + NUMBERS // 4 - 1) // (-dx) + 1)
        number, step = tl.arange(0, NUMBERS), tl.arange(0, STEPS)
        carry = tl.zeros((NUMBERS,), sums.dtype.element_ty)
        for j in range(begin, end, STEPS):
            x = 4 * (first + (j + step) * dx)[:, None] + number[None, :]
            y = tl.program_id(1) + (j + step) * dy
            mask = (x >= 0) & (x < 4 * columns) & (j + step < end)[:, None]
            at = (y * columns * 4)[:, None] + x
            fed = _fed(source, cells, at, mask, direction, INPUTS)
            tl.store(out + at, tl.cumsum(fed, axis=0) + carry[None, :], mask=mask)
            carry += tl.sum(fed, axis=0)


def sum_down(
    light: Float32[Tensor, "pixels 4"],
    lowest: Float32[Tensor, "4"],
    sums: Int[Tensor, " numbers"],
    batch: Batch,
    group: Group,
    tables: DeviceTables,
) -> None:
    """Add what comes of the sums to the light of every slice, or set it where it has no small kernels."""
    (rows, columns), pieces = group.most, len(group.numbers)
    chunks = triton.cdiv(rows, _COLUMN_ROWS)
    before = torch.zeros((chunks, pieces, 4 * columns), dtype=sums.dtype, device=sums.device)
    grid = (triton.cdiv(4 * columns, _COLUMN_NUMBERS), chunks, pieces)
    tensors = light, lowest, before, sums, tables.taps, batch.places, batch.starts, batch.scales, group.numbers
    rest = len(tables.sums), len(tables.taps), _COLUMN_ROWS, _COLUMN_STEPS, _COLUMN_NUMBERS
    _sum_columns[grid](*tensors, 4 * columns, False, *rest, num_warps=1)
    before = before.cumsum(dim=0, dtype=sums.dtype) - before
    _sum_columns[grid](light, lowest, before, *tensors[3:], 4 * columns, True, *rest, num_warps=1)


@triton.jit
@no_type_check
def _sum_columns(
    light,
    lowest,
    before,
    sums,
    taps,
    places,
    starts,
    scales,
    numbers,
    stride,
    IS_LAST: tl.constexpr,
    SUMS: tl.constexpr,
    TAPS: tl.constexpr,
    ROWS: tl.constexpr,
    STEPS: tl.constexpr,
    NUMBERS: tl.constexpr,
):
    """Sum profiles over the visible columns of the rows of one chunk: into `before`, or on from there onto the light."""
    piece = tl.load(numbers + tl.program_id(2))
    place = places + 11 * piece
    rows, columns = tl.load(place + 4), tl.load(place + 5)
    down, right = tl.load(place + 6) - tl.load(place + 2), tl.load(place + 7) - tl.load(place + 3)
    height, width, is_small = tl.load(place + 8), tl.load(place + 9), tl.load(place + 10) % 2 == 1
    top, end = tl.program_id(1) * ROWS, tl.minimum((tl.program_id(1) + 1) * ROWS, down + height)
    if (top < end) & (tl.program_id(0) * NUMBERS < 4 * width):
        number = tl.program_id(0) * NUMBERS + tl.arange(0, NUMBERS)
        step, inside = tl.arange(0, STEPS), number < 4 * width
        chunk = before + (tl.program_id(1) * tl.num_programs(2) + tl.program_id(2)) * stride + number
        source = sums + 4 * tl.load(starts + 2 * piece) * SUMS
        picture = light + 4 * tl.load(starts + 2 * piece + 1)
        total = tl.zeros((NUMBERS,), sums.dtype.element_ty)
        unit = tl.load(scales + 2 * piece + 1)
        least = tl.load(lowest + number % 4)
        if IS_LAST:
            total = tl.load(chunk, mask=inside, other=0)
        for first in range(top, end, STEPS):
            y = first + step
            mask = (y < end)[:, None] & inside[None, :]
            laid = tl.zeros((STEPS, NUMBERS), sums.dtype.element_ty)
            for tap in tl.static_range(TAPS):
                which, back_x, back_y = tl.load(taps + 4 * tap), tl.load(taps + 4 * tap + 1), tl.load(taps + 4 * tap + 2)
                row, column = y - back_y, number + 4 * (right - back_x)
                seen = mask & (row >= 0)[:, None] & ((column >= 0) & (column < 4 * columns))[None, :]
                at = which * rows * columns * 4 + (row * columns * 4)[:, None] + column[None, :]
                laid += tl.load(taps + 4 * tap + 3) * tl.load(source + at, mask=seen, other=0)
            if IS_LAST:
                here = mask & (y >= down)[:, None]
                to = picture + ((y - down) * width * 4)[:, None] + number[None, :]
                summed = tl.cumsum(laid, axis=0) + total[None, :]
                value = (summed.to(tl.float64) * unit).to(tl.float32)
                if is_small:
                    value += tl.load(to, mask=here, other=0.0)
                tl.store(to, tl.maximum(value, least[None, :]), mask=here)
            total += tl.sum(laid, axis=0)
        if not IS_LAST:
            tl.store(chunk, total, mask=inside)
