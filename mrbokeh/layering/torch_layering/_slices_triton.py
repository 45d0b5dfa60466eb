"""Kernels that find the slices of a picture and let their light claim the pupil, as `mrbokeh.layering._slices_numba` does."""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float32, Int32, Int64
from torch import Tensor

from mrbokeh.layering.torch_layering.slicing import Box

_TILE = 16, 64
"""Rows and columns that one program looks at."""


def extents(
    coc_px: Float32[Tensor, "2 height width"], shares: Float32[Tensor, "kinds height width"], first: int, numbers: int, step_px: float
) -> Int32[Tensor, "kinds numbers 4"]:
    """Return first and end row, first and end column of the pixels of each kind and slice, from number `first` on; end 0 for none."""
    kinds, height, width = shares.shape
    nowhere = torch.tensor([height, 0, width, 0], dtype=torch.int32, device=shares.device)
    boxes = nowhere.expand(kinds, numbers, 4).contiguous()
    grid = (triton.cdiv(width, _TILE[1]), triton.cdiv(height, _TILE[0]), kinds)
    _extents[grid](boxes, coc_px, shares, height, width, first, numbers, step_px, *_TILE)
    return boxes


@triton.jit
@no_type_check
def _extents(boxes, coc_px, shares, height, width, first, numbers, step_px, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    kind = tl.program_id(2)
    y, x = tl.program_id(1) * ROWS + tl.arange(0, ROWS), tl.program_id(0) * COLUMNS + tl.arange(0, COLUMNS)
    inside = (y < height)[:, None] & (x < width)[None, :]
    at = y[:, None] * width + x[None, :]
    circle = tl.load(coc_px + tl.minimum(kind, 1) * height * width + at, mask=inside, other=0.0)
    used = tl.load(shares + kind * height * width + at, mask=inside, other=0.0) > 0.0
    number = tl.floor(circle / step_px + 0.5).to(tl.int32) - first
    lowest = tl.min(tl.min(tl.where(used, number, numbers), axis=1), axis=0)
    highest = tl.max(tl.max(tl.where(used, number, -1), axis=1), axis=0)
    rows, columns = y[:, None] + 0 * x[None, :], x[None, :] + 0 * y[:, None]
    for k in range(lowest, highest + 1):
        mine = used & (number == k)
        if tl.max(tl.max(mine.to(tl.int32), axis=1), axis=0) > 0:
            box = boxes + (kind * numbers + k) * 4
            tl.atomic_min(box, tl.min(tl.min(tl.where(mine, rows, height), axis=1), axis=0))
            tl.atomic_max(box + 1, tl.max(tl.max(tl.where(mine, rows, -1), axis=1), axis=0) + 1)
            tl.atomic_min(box + 2, tl.min(tl.min(tl.where(mine, columns, width), axis=1), axis=0))
            tl.atomic_max(box + 3, tl.max(tl.max(tl.where(mine, columns, -1), axis=1), axis=0) + 1)


def claimed(
    light: Float32[Tensor, "pixels 4"], places: Int32[Tensor, "slices 11"], starts: Int64[Tensor, "slices 2"], frame: Box
) -> Float32[Tensor, "height width 4"]:
    """Return colour and how much of the pupil is taken where slices, one after the other, claim as much of it as is still free.

    places, starts: see mrbokeh.renderers.polygon.torch_polygon._batch.
    """
    colour = torch.empty((frame.rows, frame.columns, 4), dtype=torch.float32, device=light.device)
    grid = (triton.cdiv(frame.columns, _TILE[1]), triton.cdiv(frame.rows, _TILE[0] // 4))
    _claimed[grid](colour, light, places, starts, len(places), *frame, _TILE[0] // 4, _TILE[1])
    return colour


@triton.jit
@no_type_check
def _claimed(colour, light, places, starts, slices, top, left, height, width, ROWS: tl.constexpr, COLUMNS: tl.constexpr):
    first_y, first_x = top + tl.program_id(1) * ROWS, left + tl.program_id(0) * COLUMNS
    y, x = first_y + tl.arange(0, ROWS), first_x + tl.arange(0, COLUMNS)
    nothing = tl.zeros((ROWS, COLUMNS), tl.float32)
    red, green, blue, taken = nothing, nothing, nothing, nothing
    of_red, of_green, of_blue, coverage = nothing, nothing, nothing, nothing
    for piece in range(slices + 1):
        place = places + 11 * tl.minimum(piece, slices - 1)
        if (piece == slices) | (tl.load(place + 10) // 4 % 2 == 0):
            share = tl.where(coverage > 0.0, tl.minimum(1.0, (1.0 - taken) / coverage), 0.0)
            red, green, blue = red + share * of_red, green + share * of_green, blue + share * of_blue
            taken = tl.minimum(1.0, taken + tl.maximum(coverage, 0.0))
            of_red, of_green, of_blue, coverage = nothing, nothing, nothing, nothing
        box_top, box_left, rows, columns = tl.load(place + 6), tl.load(place + 7), tl.load(place + 8), tl.load(place + 9)
        meets = (first_y < box_top + rows) & (first_y + ROWS > box_top) & (first_x < box_left + columns) & (first_x + COLUMNS > box_left)
        if meets & (piece < slices):
            inside = ((y >= box_top) & (y < box_top + rows))[:, None] & ((x >= box_left) & (x < box_left + columns))[None, :]
            at = light + 4 * tl.load(starts + 2 * piece + 1) + 4 * ((y - box_top)[:, None] * columns + (x - box_left)[None, :])
            of_red += tl.load(at, mask=inside, other=0.0)
            of_green += tl.load(at + 1, mask=inside, other=0.0)
            of_blue += tl.load(at + 2, mask=inside, other=0.0)
            coverage += tl.load(at + 3, mask=inside, other=0.0)
    to = colour + 4 * ((y - top)[:, None] * width + (x - left)[None, :])
    mask = (y < top + height)[:, None] & (x < left + width)[None, :]
    tl.store(to, red, mask=mask)
    tl.store(to + 1, green, mask=mask)
    tl.store(to + 2, blue, mask=mask)
    tl.store(to + 3, taken, mask=mask)
