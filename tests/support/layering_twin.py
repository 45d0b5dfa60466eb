"""Plain twins of the kernels of mrbokeh.layering.torch_layering: edges by the compiled loops, slices and claims by torch."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import torch
from torch import Tensor

from mrbokeh.layering.hidden_background import split_edges as split_compiled
from mrbokeh.layering.padded_layers import PaddedLayer
from mrbokeh.layering.torch_layering.slicing import Box


def split_edges(values: Tensor, coc_px: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Return light and circles of confusion in front and behind, as `hidden_background.split_edges` finds them."""
    with ThreadPoolExecutor(1) as pool:
        front, behind = split_compiled(PaddedLayer(values.numpy().copy(), coc_px.numpy().copy(), True), pool)
    light, circles = np.zeros((coc_px.numel(), 4), np.float32), np.zeros(coc_px.numel(), np.float32)
    light[behind.places], circles[behind.places] = behind.values, behind.coc_px
    found = (front.values, front.coc_px), (light, circles)
    shaped = [(torch.from_numpy(v).reshape(values.shape), torch.from_numpy(c).reshape(coc_px.shape)) for v, c in found]
    return shaped[0], shaped[1]


def extents(coc_px: Tensor, shares: Tensor, first: int, numbers: int, step_px: float) -> Tensor:
    """Return first and end row, first and end column of the pixels of each kind and slice; end 0 for none."""
    kinds, height, width = shares.shape
    boxes = torch.tensor([height, 0, width, 0], dtype=torch.int32).repeat(kinds, numbers, 1)
    for kind in range(kinds):
        number = torch.floor(coc_px[min(kind, 1)] / step_px + 0.5).int() - first
        for k in range(numbers):
            y, x = torch.nonzero((number == k) & (shares[kind] > 0.0), as_tuple=True)
            if len(y):
                boxes[kind, k] = torch.stack([y.min(), y.max() + 1, x.min(), x.max() + 1]).int()
    return boxes


def claimed(light: Tensor, places: Tensor, starts: Tensor, frame: Box) -> Tensor:
    """Return colour and coverage where slices claim the pupil one after the other."""
    colour = torch.zeros((frame.rows, frame.columns, 4))
    waiting = torch.zeros_like(colour)
    for place, (_, start) in zip(places.tolist(), starts.tolist(), strict=True):
        if place[10] // 4 % 2 == 0:
            _claim(colour, waiting)
            waiting = torch.zeros_like(colour)
        seen = Box(*place[6:10])
        rays = light[start : start + seen.rows * seen.columns].reshape(seen.rows, seen.columns, 4)
        waiting[seen.top - frame.top :, seen.left - frame.left :][: seen.rows, : seen.columns] += rays
    _claim(colour, waiting)
    return colour


def _claim(colour: Tensor, rays: Tensor) -> None:
    free, coverage = 1.0 - colour[..., 3:], rays[..., 3:]
    share = torch.where(coverage > 0.0, (free / coverage.clamp(min=1e-30)).clamp(max=1.0), 0.0)
    colour[..., :3] += rays[..., :3] * share
    colour[..., 3:] = (colour[..., 3:] + coverage.clamp(min=0.0)).clamp(max=1.0)
