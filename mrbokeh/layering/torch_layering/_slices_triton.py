"""Kernels that lay out the light of a slice and let it claim the pupil, on an NVIDIA GPU; `mrbokeh.layering._slices_numba` has their twins."""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float32
from torch import Tensor

_PIXELS = 128

Picture = Float32[Tensor, "height width 4"]
Plane = Float32[Tensor, "height width"]
Window = tuple[int, int, int, int]


def light_of_slice(parts: list[tuple[Picture, Plane, Plane]], number: int, step_px: float, window: Window) -> tuple[Picture, Plane]:
    """Return the light of one slice in a window, and its circles of confusion: of values, diameters and shares of one layer, or of two.

    Where two layers share a place, the first one's circle holds for both.
    """
    top, bottom, left, right = window
    (values, coc_px, shares), (others, others_px, other_shares) = parts[0], parts[-1]
    light = torch.empty((bottom - top, right - left, 4), dtype=torch.float32, device=values.device)
    circles = torch.empty(light.shape[:2], dtype=torch.float32, device=values.device)
    tensors = light, circles, values, coc_px, shares, others, others_px, other_shares
    sizes = circles.numel(), right - left, coc_px.shape[1], top, left, number, step_px
    _light_of_slice[(triton.cdiv(circles.numel(), _PIXELS),)](*tensors, *sizes, len(parts) > 1, _PIXELS)
    return light, circles


@triton.jit
@no_type_check
def _light_of_slice(
    light,
    circles,
    values,
    coc_px,
    shares,
    others,
    others_px,
    other_shares,
    pixels,
    width,
    columns,
    top,
    left,
    number,
    step_px,
    IS_PAIR: tl.constexpr,
    PIXELS: tl.constexpr,
):
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    inside = pixel < pixels
    channel = tl.arange(0, 4)
    at = (pixel // width + top) * columns + pixel % width + left
    circle, value = _mine(values, coc_px, shares, at, channel, inside, number, step_px)
    if IS_PAIR:
        other, more = _mine(others, others_px, other_shares, at, channel, inside, number, step_px)
        circle = tl.where(circle == 0.0, other, circle)
        value += more
    tl.store(circles + pixel, circle, mask=inside)
    tl.store(light + pixel[:, None] * 4 + channel[None, :], value, mask=inside[:, None] & (channel < 4)[None, :])


@triton.jit
@no_type_check
def _mine(values, coc_px, shares, at, channel, inside, number, step_px):
    """Return diameters and light of the pixels of a layer that belong to the slice; 0 elsewhere."""
    circle = tl.load(coc_px + at, mask=inside, other=0.0)
    share = tl.load(shares + at, mask=inside, other=0.0)
    mine = inside & (share > 0.0) & (tl.floor(circle / step_px + 0.5) == number)
    value = tl.load(values + at[:, None] * 4 + channel[None, :], mask=mine[:, None] & (channel < 4)[None, :], other=0.0)
    return tl.where(mine, circle, 0.0), value * tl.where(mine, share, 0.0)[:, None]


def claim(colour: Picture, light: Picture, top: int, left: int) -> None:
    """Add light to colour as far as the pupil is still free, its coverage to the last channel. top, left: of the light in the frame."""
    height, width, _ = light.shape
    sizes = height * width, width, *colour.shape[:2], top, left
    _claim[(triton.cdiv(height * width, _PIXELS),)](colour, light, *sizes, _PIXELS)


@triton.jit
@no_type_check
def _claim(colour, light, pixels, width, frame_height, frame_width, top, left, PIXELS: tl.constexpr):
    pixel = tl.program_id(0) * PIXELS + tl.arange(0, PIXELS)
    y, x = pixel // width + top, pixel % width + left
    inside = (pixel < pixels) & (y >= 0) & (y < frame_height) & (x >= 0) & (x < frame_width)
    channel = tl.arange(0, 4)
    both = inside[:, None] & (channel < 4)[None, :]
    to = colour + (y * frame_width + x)[:, None] * 4 + channel[None, :]
    rays = tl.load(light + pixel[:, None] * 4 + channel[None, :], mask=both, other=0.0)
    there = tl.load(to, mask=both, other=0.0)
    is_coverage = (channel == 3)[None, :]
    coverage = tl.sum(tl.where(is_coverage, rays, 0.0), axis=1)
    taken = tl.sum(tl.where(is_coverage, there, 0.0), axis=1)
    share = tl.where(coverage > 0.0, tl.minimum(1.0, (1.0 - taken) / coverage), 0.0)
    claimed = there + rays * share[:, None]
    full = tl.minimum(1.0, taken + tl.maximum(0.0, coverage))
    tl.store(to, tl.where(is_coverage, full[:, None], claimed), mask=both)
