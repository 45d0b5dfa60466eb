"""Layering on a device: one opaque picture with depth is cut into slices there, blurred slice by slice and put together again.

The same steps as mrbokeh.layering.layering, by Triton kernels: edges are split and the background behind them filled in
(`_edges_triton`), pixels are sorted into slices of the signed circle of confusion, and each slice claims what is still free of the pupil,
front first. What is hidden claims last, but right before its slice where it lies across the focus from what hides it. Slices are
blurred in the window that their light reaches. For plain apertures, without motion and other channels; other pictures go by the
compiled loops, with their sums on the device.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from math import ceil, floor
from typing import Any

import torch
from jaxtyping import Bool, Float32, Int32
from torch import Tensor
from torch.nn.functional import pad

from mrbokeh.layering.hidden_background import RIM_PX, STEP_PX, SURFACE_PX
from mrbokeh.layering.highlights import LIGHT_OVER_SURROUNDINGS
from mrbokeh.layering.layering import NOTHING_TAKEN
from mrbokeh.layering.padded_layers import BORDER_PX
from mrbokeh.layering.slices import LEAST_STEP_PX, SHARP_PX
from mrbokeh.layering.torch_layering._edges_triton import fill, look, seeds_behind, unmix
from mrbokeh.layering.torch_layering._slices_triton import claim, light_of_slice

Picture = Float32[Tensor, "height width 4"]
Plane = Float32[Tensor, "height width"]
Mask = Bool[Tensor, "height width"]
KernelSum = Callable[[Picture, Plane, float, float], Picture]
"""Return the sum of kernels of light with signed diameters, whose sizes lie between the last two arguments where there is light."""


@dataclass(frozen=True)
class Pixels:
    """Light of one layer with its margin, and its circles of confusion. values (H, W, 4), coc_px (H, W)."""

    values: Picture
    coc_px: Plane


def padded(rgb: Float32[Tensor, "height width 3"], coc_px: Plane, margin_px: int) -> Pixels:
    """Return an opaque picture continued by its border, without highlights there, so that light comes in from beyond the frame."""
    rgba = torch.cat([rgb, torch.ones_like(rgb[..., :1])], dim=2)
    if margin_px == 0:
        return Pixels(rgba, coc_px)
    dark = rgba.clone()
    for border in (slice(None, BORDER_PX), slice(-BORDER_PX, None)):
        dark[border] = _without_highlights(dark[border])
    for border in (slice(None, BORDER_PX), slice(-BORDER_PX, None)):
        dark[:, border] = _without_highlights(dark[:, border])
    values = pad(dark.permute(2, 0, 1), (margin_px,) * 4, mode="replicate").permute(1, 2, 0).contiguous()
    values[margin_px:-margin_px, margin_px:-margin_px] = rgba
    return Pixels(values, pad(coc_px[None], (margin_px,) * 4, mode="replicate")[0])


def _without_highlights(values: Picture) -> Picture:
    """Return a strip with the median of the surroundings in place of pixels several times brighter than most of them."""
    height, width, _ = values.shape
    wide = pad(values[..., :3].permute(2, 0, 1), (2, 2, 2, 2), mode="replicate")
    around = torch.stack([wide[:, dy : dy + height, dx : dx + width] for dy in range(5) for dx in range(5)])
    brightness = around.amax(dim=1)
    lit = (LIGHT_OVER_SURROUNDINGS * brightness < brightness[12]).sum(dim=0) > 12
    colours = torch.where(lit, around.median(dim=0).values, values[..., :3].permute(2, 0, 1))
    return torch.cat([colours.permute(1, 2, 0), values[..., 3:]], dim=2)


def split_edges(layer: Pixels, farthest_px: int) -> tuple[Pixels, Pixels]:
    """Return an opaque layer as what is in front, with soft edges, and what lies behind them, of coverage 0 where nothing is known."""
    snapped, lit = look(layer.values, layer.coc_px, float(LIGHT_OVER_SURROUNDINGS), STEP_PX)
    seeds, of_rims, pure_px = seeds_behind(snapped, lit, STEP_PX, RIM_PX, farthest_px)
    behind, behind_px = fill(layer.values, seeds, pure_px, SURFACE_PX, farthest_px)
    front, front_px = unmix(layer.values, snapped, lit, of_rims, behind, STEP_PX)
    return Pixels(front, front_px), Pixels(behind, behind_px)


@dataclass(frozen=True)
class _Shared:
    """Pixels of a layer that take part in one round of slices: the share of each that is meant."""

    pixels: Pixels
    shares: Plane


def render(
    rgb: Float32[Tensor, "height width 3"], coc_px: Plane, margin_px: int, largest_px: float, slices: int, sum_kernels: KernelSum
) -> Picture:
    """Return an opaque picture as the lens sees it: R, G, B and coverage 1.

    rgb: linear. coc_px: signed diameters at which kernels are drawn, none larger than largest_px. margin_px: how far light travels.
    """
    height, width = coc_px.shape
    layer = padded(rgb, coc_px, margin_px)
    front, behind = split_edges(layer, ceil(largest_px) + 4)
    shown = 1.0 - front.values[..., 3]
    across = (behind.coc_px > SHARP_PX) & (front.coc_px < -SHARP_PX) & (front.values[..., 3] > 0.0)
    crossing = torch.where(across, 1.0 - shown, 0.0)
    hidden = 1.0 - shown - crossing
    nearest, farthest = torch.stack([layer.coc_px.amin(), layer.coc_px.amax()]).tolist()
    cut = _Cut(max((farthest - nearest) / slices, LEAST_STEP_PX), margin_px, (height, width), max(-nearest, farthest))
    everything = [
        [[_Shared(behind, crossing)], [_Shared(front, torch.ones_like(shown)), _Shared(behind, shown)]],
        [[_Shared(behind, hidden)]],
    ]
    colour = torch.zeros((height, width, 4), dtype=torch.float32, device=rgb.device)
    for rounds in everything:
        for number, parts, box in cut.in_turn(rounds):
            _blur_onto(colour, number, parts, box, cut, sum_kernels)
    taken = colour[..., 3:].clamp(min=float(NOTHING_TAKEN))
    return torch.cat([colour[..., :3] / taken, torch.ones_like(taken)], dim=2)


@dataclass(frozen=True)
class _Cut:
    """How a picture is cut: the step between slices, the margin, the frame's height and width, and the largest diameter."""

    step_px: float
    margin_px: int
    frame_px: tuple[int, int]
    largest_px: float

    def in_turn(self, rounds: list[list[_Shared]]) -> Iterator[tuple[int, list[_Shared], Any]]:
        """Yield number, parts and box of slices that are not empty, front first; of one number in the order given."""
        boxes = [[self.boxes(part) for part in parts] for parts in rounds]
        numbers = sorted({number for of_round in boxes for of_part in of_round for number in of_part})
        for number in numbers:
            for parts, of_round in zip(rounds, boxes, strict=True):
                here = [(part, found[number]) for part, found in zip(parts, of_round, strict=True) if number in found]
                if here:
                    tops, bottoms, lefts, rights = zip(*(box for _, box in here), strict=True)
                    yield number, [part for part, _ in here], (min(tops), max(bottoms), min(lefts), max(rights))

    def numbers(self, part: _Shared) -> Int32[Tensor, "height width"]:
        return torch.floor(part.pixels.coc_px / self.step_px + 0.5).int()

    def boxes(self, part: _Shared) -> dict[int, tuple[int, int, int, int]]:
        """Return by number of slice the first and end row, first and end column of its pixels, in the array with its margin."""
        lit = (part.shares > 0.0) & (part.pixels.values[..., 3] > 0.0)
        first = floor(-self.largest_px / self.step_px) - 1
        count = 2 - 2 * first
        number = torch.where(lit, self.numbers(part) - first, count)
        rows, columns = number.shape
        marks = []
        for plane, size in ((number, rows), (number.T, columns)):
            held = torch.zeros((size, count + 1), dtype=torch.int8, device=number.device)
            marks.append(held.scatter_(1, plane.long(), 1)[:, :count].cpu().numpy())
        of_rows, of_columns = marks
        found = {}
        for k in of_rows.any(axis=0).nonzero()[0].tolist():
            y, x = of_rows[:, k].nonzero()[0], of_columns[:, k].nonzero()[0]
            found[k + first] = int(y[0]), int(y[-1]) + 1, int(x[0]), int(x[-1]) + 1
        return found


def _blur_onto(
    colour: Picture, number: int, parts: list[_Shared], box: tuple[int, int, int, int], cut: _Cut, sum_kernels: KernelSum
) -> None:
    """Blur one slice in the window that its light reaches, and let it claim what is free of the pupil."""
    least_px, largest_px = (abs(number) - 0.501) * cut.step_px, min((abs(number) + 0.501) * cut.step_px, cut.largest_px)
    reach = min(ceil(0.5 * largest_px) + 1, cut.margin_px) if largest_px > 1.0 else 0
    window = _window(box, reach, cut)
    if window is None:
        return
    top, bottom, left, right = window
    light, coc_px = light_of_slice([(part.pixels.values, part.pixels.coc_px, part.shares) for part in parts], number, cut.step_px, window)
    blurred = sum_kernels(light, coc_px, least_px, largest_px)
    claim(colour, blurred, top - cut.margin_px, left - cut.margin_px)


def _window(box: tuple[int, int, int, int], reach: int, cut: _Cut) -> tuple[int, int, int, int] | None:
    """Return first and end row, first and end column of pixels of a slice whose light reaches the frame, and of where it arrives."""
    found = []
    for (first, end), length in zip((box[:2], box[2:]), cut.frame_px, strict=True):
        inside = cut.margin_px, cut.margin_px + length
        first, end = max(first, inside[0] - reach), min(end, inside[1] + reach)
        if first >= end:
            return None
        found += [min(first, max(first - reach, inside[0])), max(end, min(end + reach, inside[1]))]
    return found[0], found[1], found[2], found[3]
