"""Kernels that split the edges of an opaque picture on an NVIDIA GPU; `mrbokeh.layering._hidden_background_numba` says what each finds.

One thread a pixel, all of the picture at once: the brush fire that looks for what lies behind an edge goes in leaps there.
"""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Bool, Float32, Int32
from torch import Tensor

from mrbokeh.layering._hidden_background_numba import LARGEST_SHARE

_PIXELS = 128
_FEW = 32
"""Pixels that one program looks at, where each looks far around."""

Picture = Float32[Tensor, "height width 4"]
Plane = Float32[Tensor, "height width"]
Places = Int32[Tensor, "height width"]
Mask = Bool[Tensor, "height width"]


def look(values: Picture, coc_px: Plane, ratio: float, step_px: float) -> tuple[Plane, Mask]:
    """Return circles of confusion without pixels between two surfaces, and the mask of highlights."""
    height, width = coc_px.shape
    brightness, snapped = values[..., :3].amax(dim=2), torch.empty_like(coc_px)
    lit = torch.empty(coc_px.shape, dtype=torch.bool, device=coc_px.device)
    grid = (triton.cdiv(coc_px.numel(), _PIXELS),)
    _look[grid](snapped, lit, brightness, coc_px, height, width, ratio, 0.5 * step_px, 2.0 * step_px, _PIXELS)
    return snapped, lit


@triton.jit
@no_type_check
def _at(plane, y, x, height, width, mask):
    """Load pixels; beyond the frame its border goes on."""
    y, x = tl.minimum(tl.maximum(y, 0), height - 1), tl.minimum(tl.maximum(x, 0), width - 1)
    return tl.load(plane + y * width + x, mask=mask, other=0.0)


@triton.jit
@no_type_check
def _beside(plane, y, x, by, height, width, mask, WAY: tl.constexpr):
    """Load pixels `by` places on: to the right, down, or down to either side."""
    if WAY == 0:
        found = _at(plane, y, x + by, height, width, mask)
    elif WAY == 1:
        found = _at(plane, y + by, x, height, width, mask)
    elif WAY == 2:
        found = _at(plane, y + by, x + by, height, width, mask)
    else:
        found = _at(plane, y + by, x - by, height, width, mask)
    return found


@triton.jit
@no_type_check
def _between(result, circle, coc_px, y, x, height, width, uneven, even_px, apart_px, WAY: tl.constexpr):
    """Return the nearer of two even surfaces on opposite sides where the pixel lies between them, else what was found before."""
    back_1 = _beside(coc_px, y, x, -1, height, width, uneven, WAY)
    back_2 = _beside(coc_px, y, x, -2, height, width, uneven, WAY)
    back_3 = _beside(coc_px, y, x, -3, height, width, uneven, WAY)
    on_1 = _beside(coc_px, y, x, 1, height, width, uneven, WAY)
    on_2 = _beside(coc_px, y, x, 2, height, width, uneven, WAY)
    on_3 = _beside(coc_px, y, x, 3, height, width, uneven, WAY)
    here = uneven & ((tl.abs(circle - on_1) > even_px) | (tl.abs(circle - back_1) > even_px))
    result = _nearer(result, circle, back_1, back_2, on_1, on_2, here, even_px, apart_px)
    result = _nearer(result, circle, back_1, back_2, on_2, on_3, here, even_px, apart_px)
    result = _nearer(result, circle, back_2, back_3, on_1, on_2, here, even_px, apart_px)
    return _nearer(result, circle, back_2, back_3, on_2, on_3, here, even_px, apart_px)


@triton.jit
@no_type_check
def _nearer(result, circle, a, beyond_a, b, beyond_b, here, even_px, apart_px):
    found = here & (tl.abs(a - beyond_a) <= even_px) & (tl.abs(circle - a) > even_px)
    found = found & ((circle - a) * (b - circle) > 0.0) & (tl.abs(b - circle) > even_px)
    found = found & (tl.abs(b - beyond_b) <= even_px) & (tl.abs(b - a) > apart_px)
    return tl.where(found, tl.where(tl.abs(circle - a) < tl.abs(b - circle), a, b), result)


@triton.jit
@no_type_check
def _look(snapped, lit, brightness, coc_px, height, width, ratio, even_px, apart_px, PIXELS: tl.constexpr):
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = pixel < height * width
    y, x = pixel // width, pixel % width
    here = tl.load(brightness + pixel, mask=inside, other=0.0)
    darker = tl.zeros((PIXELS,), tl.int32)
    for dy in tl.static_range(-2, 3):
        for dx in tl.static_range(-2, 3):
            darker += (ratio * _at(brightness, y + dy, x + dx, height, width, inside) < here).to(tl.int32)
    is_lit = darker >= 13
    tl.store(lit + pixel, is_lit, mask=inside)
    circle = tl.load(coc_px + pixel, mask=inside, other=0.0)
    low, high = circle, circle
    for dy in tl.static_range(-1, 2):
        for dx in tl.static_range(-1, 2):
            there = _at(coc_px, y + dy, x + dx, height, width, inside)
            low, high = tl.minimum(low, there), tl.maximum(high, there)
    uneven = inside & (tl.maximum(circle - low, high - circle) > even_px) & (is_lit == 0)
    uneven = uneven & (y >= 3) & (y < height - 3) & (x >= 3) & (x < width - 3)
    result = circle
    if tl.max(uneven.to(tl.int32), axis=0) > 0:
        for way in tl.static_range(4):
            result = _between(result, circle, coc_px, y, x, height, width, uneven, even_px, apart_px, way)
    tl.store(snapped + pixel, result, mask=inside)


def seeds_behind(coc_px: Plane, lit: Mask, step_px: float, rim_px: int, farthest_px: int) -> tuple[Places, Places, Plane]:
    """Return one plus the place of the pixel seen behind each pixel, 0 where none is; the same for rims alone; and the circles of
    confusion of pure pixels, NaN elsewhere.

    farthest_px: how far behind an edge the lens sees at most.
    """
    height, width = coc_px.shape
    pure_px, of_rims, seeds = torch.empty_like(coc_px), *(torch.empty(coc_px.shape, dtype=torch.int32, device=coc_px.device) for _ in "12")
    grid = (triton.cdiv(coc_px.numel(), _PIXELS),)
    _find_pure[grid](pure_px, coc_px, lit, height, width, step_px, _PIXELS)
    _pure_beside[grid](of_rims, pure_px, coc_px, height, width, step_px, rim_px, _PIXELS)
    _start[grid](seeds, of_rims, coc_px, height, width, step_px, _PIXELS)
    other = torch.empty_like(seeds)
    for leap in _leaps(farthest_px):
        _spread[grid](other, seeds, coc_px, height, width, step_px, leap, _PIXELS)
        seeds, other = other, seeds
    return torch.where(of_rims > 0, of_rims, seeds), of_rims, pure_px


def _leaps(farthest_px: int) -> list[int]:
    """Return distances at which pixels look for seeds, one after the other: powers of two down to a step, and that twice more."""
    return [*(1 << k for k in reversed(range(max(farthest_px, 1).bit_length()))), 1, 1]


@triton.jit
@no_type_check
def _lowest(coc_px, y, x, height, width, mask):
    """Return the least of the 3x3 pixels around each."""
    low = _at(coc_px, y, x, height, width, mask)
    for dy in tl.static_range(-1, 2):
        for dx in tl.static_range(-1, 2):
            low = tl.minimum(low, _at(coc_px, y + dy, x + dx, height, width, mask))
    return low


@triton.jit
@no_type_check
def _find_pure(pure_px, coc_px, lit, height, width, step_px, PIXELS: tl.constexpr):
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = pixel < height * width
    y, x = pixel // width, pixel % width
    here = tl.load(coc_px + pixel, mask=inside, other=0.0)
    low = _lowest(coc_px, y, x, height, width, inside)
    is_pure = (here - low <= step_px) & (tl.load(lit + pixel, mask=inside, other=1) == 0)
    tl.store(pure_px + pixel, tl.where(is_pure, here, float("nan")), mask=inside)


@triton.jit
@no_type_check
def _pure_beside(of_rims, pure_px, coc_px, height, width, step_px, radius, PIXELS: tl.constexpr):
    """Set one plus the nearest pure pixel of the same surface, for rims that have one; 0 elsewhere."""
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = pixel < height * width
    y, x = pixel // width, pixel % width
    here = tl.load(coc_px + pixel, mask=inside, other=0.0)
    low = _lowest(coc_px, y, x, height, width, inside)
    rim = inside & (here - low > step_px)
    found = tl.zeros((PIXELS,), tl.int32)
    if tl.max(rim.to(tl.int32), axis=0) > 0:
        least = tl.zeros((PIXELS,), tl.int32) + (radius + 1) * (radius + 1)
        for dy in range(-radius, radius + 1):
            for dx in range(-radius, radius + 1):
                ny, nx = y + dy, x + dx
                there = rim & (ny >= 0) & (ny < height) & (nx >= 0) & (nx < width)
                circle = tl.load(pure_px + ny * width + nx, mask=there, other=float("nan"))
                better = there & (tl.abs(circle - here) <= step_px) & (dy * dy + dx * dx < least)
                least = tl.where(better, dy * dy + dx * dx, least)
                found = tl.where(better, ny * width + nx + 1, found)
    tl.store(of_rims + pixel, found, mask=inside)


@triton.jit
@no_type_check
def _better(found, least, seed, y, x, here, coc_px, width, step_px, mask):
    """Return the better of two seeds for each pixel, and its squared distance; of two as near, the first in the picture."""
    offered = mask & (seed > 0)
    place = tl.maximum(seed - 1, 0)
    behind = tl.load(coc_px + place, mask=offered, other=0.0) - here
    dy, dx = place // width - y, place % width - x
    square = dy * dy + dx * dx
    sight = 0.5 * behind + 3.5
    nearer = (square < least) | ((square == least) & (seed < found))
    takes = offered & (behind > step_px) & (square.to(tl.float32) <= sight * sight) & nearer
    return tl.where(takes, seed, found), tl.where(takes, square, least)


_FAR = tl.constexpr(1 << 30)


@triton.jit
@no_type_check
def _start(seeds, of_rims, coc_px, height, width, step_px, PIXELS: tl.constexpr):
    """Offer the seeds of rims to nearer pixels beside them."""
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = pixel < height * width
    y, x = pixel // width, pixel % width
    here = tl.load(coc_px + pixel, mask=inside, other=0.0)
    found, least = tl.zeros((PIXELS,), tl.int32), tl.zeros((PIXELS,), tl.int32) + _FAR
    for dy in tl.static_range(-1, 2):
        for dx in tl.static_range(-1, 2):
            ny, nx = y + dy, x + dx
            there = inside & (ny >= 0) & (ny < height) & (nx >= 0) & (nx < width)
            at = ny * width + nx
            seed = tl.load(of_rims + at, mask=there, other=0)
            there = there & (seed > 0)
            there = there & (here < tl.load(coc_px + at, mask=there, other=0.0) - step_px)
            found, least = _better(found, least, seed, y, x, here, coc_px, width, step_px, there)
    tl.store(seeds + pixel, found, mask=inside)


@triton.jit
@no_type_check
def _spread(out, seeds, coc_px, height, width, step_px, leap, PIXELS: tl.constexpr):
    """Let each pixel take the best of its own seed and those of pixels a leap away."""
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = pixel < height * width
    y, x = pixel // width, pixel % width
    here = tl.load(coc_px + pixel, mask=inside, other=0.0)
    found, least = tl.zeros((PIXELS,), tl.int32), tl.zeros((PIXELS,), tl.int32) + _FAR
    for dy in tl.static_range(-1, 2):
        for dx in tl.static_range(-1, 2):
            ny, nx = y + dy * leap, x + dx * leap
            there = inside & (ny >= 0) & (ny < height) & (nx >= 0) & (nx < width)
            seed = tl.load(seeds + ny * width + nx, mask=there, other=0)
            found, least = _better(found, least, seed, y, x, here, coc_px, width, step_px, there)
    tl.store(out + pixel, found, mask=inside)


def fill(values: Picture, seeds: Places, pure_px: Plane, surface_px: float, farthest_px: int) -> tuple[Picture, Plane]:
    """Return the background where there are seeds, interpolated from pure pixels of the seed's surface around; 0 elsewhere."""
    height, width = pure_px.shape
    out, out_px = torch.empty_like(values), torch.empty_like(pure_px)
    grid = (triton.cdiv(pure_px.numel(), _FEW),)
    most = 2 * farthest_px + 3
    _fill[grid](out, out_px, values, seeds, pure_px, height, width, surface_px, most, _FEW, num_warps=1)
    return out, out_px


@triton.jit
@no_type_check
def _fill(out, out_px, values, seeds, pure_px, height, width, surface_px, most, PIXELS: tl.constexpr):
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = pixel < height * width
    channel = tl.arange(0, 4)
    seed = tl.load(seeds + pixel, mask=inside, other=0)
    has, place = seed > 0, tl.maximum(seed - 1, 0)
    light, circle = tl.zeros((PIXELS, 4), tl.float32), tl.zeros((PIXELS,), tl.float32)
    if tl.max(seed, axis=0) > 0:
        y, x = pixel // width, pixel % width
        sy, sx = place // width, place % width
        nearest = tl.sqrt(((sy - y) * (sy - y) + (sx - x) * (sx - x)).to(tl.float32))
        surface = tl.load(pure_px + place, mask=has, other=0.0)
        clipped = tl.maximum(nearest, 0.5)
        total = tl.where(has, 1.0 / (clipped * clipped), 1.0)
        circle = total * surface
        light = total[:, None] * tl.load(
            values + place[:, None] * 4 + channel[None, :], mask=has[:, None] & (channel < 4)[None, :], other=0.0
        )
        farthest = tl.minimum((2.0 * nearest + 3.0).to(tl.int32), most)
        last = tl.max(tl.where(has, farthest + farthest // 4, 0), axis=0)
        for way in range(8):
            angle = way * 0.7853981633974483
            down, right = tl.sin(angle), tl.cos(angle)
            near, is_over = tl.zeros((PIXELS,), tl.int32), has == 0
            distance = 1
            while (distance <= last) & (tl.min(is_over.to(tl.int32), axis=0) == 0):
                ny, nx = y + _rounded(distance * down), x + _rounded(distance * right)
                there = (is_over == 0) & (ny >= 0) & (ny < height) & (nx >= 0) & (nx < width)
                at = ny * width + nx
                coc = tl.load(pure_px + at, mask=there, other=float("nan"))
                is_on = there & (tl.abs(coc - surface) <= surface_px)
                near = tl.where((near == 0) & is_on & (distance <= farthest), distance, near)
                started = near > 0
                is_over = is_over | (started & ((is_on == 0) | (distance >= near + tl.maximum(1, near // 4))))
                is_over = is_over | ((started == 0) & (distance >= farthest))
                counts = started & is_on & (is_over == 0)
                weight = tl.where(counts, 1.0 / (near * near * tl.maximum(1, near // 4)).to(tl.float32), 0.0)
                total += weight
                circle += tl.where(counts, weight * coc, 0.0)
                here = tl.load(values + at[:, None] * 4 + channel[None, :], mask=counts[:, None] & (channel < 4)[None, :], other=0.0)
                light += weight[:, None] * here
                distance += 1
        light = light / total[:, None]
        circle = circle / total
    tl.store(out + pixel[:, None] * 4 + channel[None, :], tl.where(has[:, None], light, 0.0), mask=inside[:, None] & (channel < 4)[None, :])
    tl.store(out_px + pixel, tl.where(has, circle, 0.0), mask=inside)


@triton.jit
@no_type_check
def _rounded(number):
    """Round to a whole number; halves, which paths do not meet but by chance, go up."""
    return tl.floor(number + 0.5).to(tl.int32)


def unmix(values: Picture, coc_px: Plane, lit: Mask, of_rims: Places, behind: Picture, step_px: float) -> tuple[Picture, Plane]:
    """Return the front with its share of rims; what is left of them replaces, in place, what was filled in behind."""
    height, width = coc_px.shape
    front, front_px = torch.empty_like(values), torch.empty_like(coc_px)
    grid = (triton.cdiv(coc_px.numel(), _PIXELS),)
    _unmix[grid](front, front_px, values, coc_px, lit, of_rims, behind, height, width, step_px, LARGEST_SHARE, _PIXELS)
    return front, front_px


@triton.jit
@no_type_check
def _unmix(front, front_px, values, coc_px, lit, of_rims, behind, height, width, step_px, largest_share, PIXELS: tl.constexpr):
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = pixel < height * width
    channel = tl.arange(0, 4)
    both = inside[:, None] & (channel < 4)[None, :]
    cells = pixel[:, None] * 4 + channel[None, :]
    value, here = tl.load(values + cells, mask=both, other=0.0), tl.load(coc_px + pixel, mask=inside, other=0.0)
    result, circle = value, here
    rim = inside & (tl.load(of_rims + pixel, mask=inside, other=0) > 0)
    if tl.max(rim.to(tl.int32), axis=0) > 0:
        y, x = pixel // width, pixel % width
        filled = tl.load(behind + cells, mask=rim[:, None] & (channel < 4)[None, :], other=0.0)
        colours = (channel < 3)[None, :]
        most, near_px = tl.zeros((PIXELS,), tl.float32), here
        nearer = tl.zeros((PIXELS, 4), tl.float32)
        for dy in tl.static_range(-1, 2):
            for dx in tl.static_range(-1, 2):
                ny, nx = y + dy, x + dx
                there = rim & (ny >= 0) & (ny < height) & (nx >= 0) & (nx < width)
                at = ny * width + nx
                coc = tl.load(coc_px + at, mask=there, other=0.0)
                there = there & (coc < here - step_px)
                colour = tl.load(values + at[:, None] * 4 + channel[None, :], mask=there[:, None] & (channel < 4)[None, :], other=0.0)
                apart = tl.sum(tl.where(colours, (colour - filled) * (colour - filled), 0.0), axis=1)
                better = there & (apart > most)
                most, near_px = tl.where(better, apart, most), tl.where(better, coc, near_px)
                nearer = tl.where(better[:, None], colour, nearer)
        brightest, lamp_near = tl.zeros((PIXELS,), tl.float32) - 1.0, here > here
        for dy in tl.static_range(-2, 3):
            for dx in tl.static_range(-2, 3):
                ny, nx = y + dy, x + dx
                there = rim & (ny >= 0) & (ny < height) & (nx >= 0) & (nx < width)
                at = ny * width + nx
                bright = tl.load(values + at * 4, mask=there, other=-1.0) + tl.load(values + at * 4 + 1, mask=there, other=0.0)
                bright += tl.load(values + at * 4 + 2, mask=there, other=0.0)
                better = there & (bright > brightest)
                brightest = tl.where(better, bright, brightest)
                lamp_near = tl.where(better, tl.load(coc_px + at, mask=there, other=0.0) < here - step_px, lamp_near)
        along = tl.sum(tl.where(colours, (value - filled) * (nearer - filled), 0.0), axis=1)
        off = tl.sum(tl.where(colours, (value - filled) * (value - filled), 0.0), axis=1)
        is_lit = tl.load(lit + pixel, mask=rim, other=0) != 0
        mixed = rim & (most > 0.0) & ((is_lit == 0) | lamp_near) & (along <= most)
        explained = tl.where((off > 0.0) & (along > 0.0) & mixed, along * along / (most * off), 0.0)
        share = tl.where(mixed, tl.minimum(explained * along / most, largest_share), 0.0)
        rest = (value - share[:, None] * nearer) / (1.0 - share)[:, None]
        rest = tl.where(colours, tl.maximum(rest, 0.0), rest)
        kept = value - (1.0 - share)[:, None] * rest
        is_alpha = (channel == 3)[None, :]
        result = tl.where(mixed[:, None], tl.where(is_alpha, share[:, None], kept), value)
        circle = tl.where(mixed, near_px, here)
        tl.store(behind + cells, tl.where(is_alpha, 1.0, rest), mask=mixed[:, None] & (channel < 4)[None, :])
    tl.store(front + cells, result, mask=both)
    tl.store(front_px + pixel, circle, mask=inside)
