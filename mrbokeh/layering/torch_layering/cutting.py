"""Layering on a device: one opaque picture with depth is cut into slices there, blurred slice by slice and put together again.

The same steps as mrbokeh.layering.layering, by Triton kernels: edges are split and the background behind them filled in
(`_edges_triton`), pixels are sorted into slices of the signed circle of confusion, and each slice claims what is still free of the pupil,
front first. What is hidden claims last, but right before its slice where it lies across the focus from what hides it. Slices are
blurred in the window that their light reaches. For plain apertures, without motion and other channels; other pictures go by the
compiled loops, with their sums on the device.
"""

import math
from dataclasses import dataclass
from itertools import pairwise

import torch
from jaxtyping import Float32
from torch import Tensor
from torch.nn.functional import pad

from mrbokeh.layering.hidden_background import RIM_PX, STEP_PX, SURFACE_PX
from mrbokeh.layering.highlights import LIGHT_OVER_SURROUNDINGS
from mrbokeh.layering.layering import NOTHING_TAKEN
from mrbokeh.layering.padded_layers import BORDER_PX
from mrbokeh.layering.slices import LEAST_STEP_PX, SHARP_PX
from mrbokeh.layering.torch_layering._edges_triton import fill, look, seeds_behind, unmix
from mrbokeh.layering.torch_layering._slices_triton import claimed, extents
from mrbokeh.layering.torch_layering.slicing import Box, Slice, Slices

Picture = Float32[Tensor, "height width 4"]
Plane = Float32[Tensor, "height width"]


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
    lit = (float(LIGHT_OVER_SURROUNDINGS) * brightness < brightness[12]).sum(dim=0) > 12
    if not bool(lit.any()):
        return values
    colours = torch.where(lit, around.median(dim=0).values, values[..., :3].permute(2, 0, 1))
    return torch.cat([colours.permute(1, 2, 0), values[..., 3:]], dim=2)


def split_edges(layer: Pixels, farthest_px: int) -> tuple[Pixels, Pixels]:
    """Return an opaque layer as what is in front, with soft edges, and what lies behind them, of coverage 0 where nothing is known."""
    snapped, lit = look(layer.values, layer.coc_px, float(LIGHT_OVER_SURROUNDINGS), STEP_PX)
    seeds, of_rims, pure_px = seeds_behind(snapped, lit, STEP_PX, RIM_PX, farthest_px)
    behind, behind_px = fill(layer.values, seeds, pure_px, SURFACE_PX, farthest_px)
    front, front_px = unmix(layer.values, snapped, lit, of_rims, behind, STEP_PX)
    return Pixels(front, front_px), Pixels(behind, behind_px)


CROSSING, SHOWN, HIDDEN = 1, 2, 3
"""Kinds of pixels behind edges: those that claim right before their slice, with it, and last. Kind 0 is the front."""


def cut(rgb: Float32[Tensor, "height width 3"], coc_px: Plane, margin_px: int, largest_px: float, slices: int) -> Slices:
    """Return an opaque picture cut into slices, with the background behind its edges.

    rgb: linear. coc_px: signed diameters at which kernels are drawn, none larger than largest_px. margin_px: how far light travels.
    """
    layer = padded(rgb, coc_px, margin_px)
    front, behind = split_edges(layer, math.ceil(largest_px) + 4)
    shown = 1.0 - front.values[..., 3]
    sharp_px = float(SHARP_PX)
    across = (behind.coc_px > sharp_px) & (front.coc_px < -sharp_px) & (front.values[..., 3] > 0.0)
    crossing = torch.where(across, front.values[..., 3], 0.0)
    known = (behind.values[..., 3] > 0.0).float()
    shares = torch.stack([torch.ones_like(shown), crossing, shown * known, (1.0 - shown - crossing).clamp(min=0.0) * known])
    circles = torch.stack([front.coc_px, behind.coc_px])
    nearest, farthest = (end(each, 0.0) for end, each in zip((min, max), torch.stack(layer.coc_px.aminmax()).tolist(), strict=True))
    step_px = max((farthest - nearest) / slices, LEAST_STEP_PX)
    first = math.floor(nearest / step_px + 0.5) - 1
    boxes = extents(circles, shares, first, math.floor(farthest / step_px + 0.5) + 2 - first, step_px).tolist()
    found = _in_turn(boxes, first)
    order = torch.full((len(shares), len(boxes[0])), -1, dtype=torch.int32)
    for place, each in enumerate(found):
        order[each.kind, each.number - first] = place
    height, width = coc_px.shape
    return Slices(
        values=torch.stack([front.values, behind.values]),
        coc_px=circles,
        shares=shares,
        slices=found,
        order=order.to(rgb.device),
        first=first,
        step_px=step_px,
        frame=Box(margin_px, margin_px, height, width),
        largest_px=largest_px,
    )


def _in_turn(boxes: list[list[list[int]]], first: int) -> list[Slice]:
    """Return slices that are not empty in the order in which they claim the pupil. boxes (kinds, numbers, 4): see `extents`."""
    found = [
        [Slice(kind, first + k, Box(box[0], box[2], box[1] - box[0], box[3] - box[2])) for k, box in enumerate(of_kind) if box[1] > box[0]]
        for kind, of_kind in enumerate(boxes)
    ]
    together = sorted([*found[CROSSING], *found[0], *found[SHOWN]], key=lambda each: (each.number, (1, 0, 2, 3)[each.kind]))
    for k, (before, here) in enumerate(pairwise(together), 1):
        together[k] = here._replace(joins=here.kind == SHOWN and (before.kind, before.number) == (0, here.number))
    return [*together, *found[HIDDEN]]


def put_together(light: Tensor, places: Tensor, starts: Tensor, frame: Box) -> Picture:
    """Return the picture of which slices claim the pupil one after the other; it is opaque, so what is left is shared out.

    light (N, 4): of all slices. places (S, 11), starts (S, 2): see mrbokeh.renderers.polygon.torch_polygon.
    """
    colour = claimed(light, places, starts, frame)
    taken = colour[..., 3:].clamp(min=float(NOTHING_TAKEN))
    return torch.cat([colour[..., :3] / taken, torch.ones_like(taken)], dim=2)
