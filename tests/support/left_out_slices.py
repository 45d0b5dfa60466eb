"""Slices of a focal stack predicted from the others, and how near they come."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mrbokeh.images.image_metrics import psnr
from mrbokeh.refocus import Refocusing
from mrbokeh.renderers.base import Renderer
from mrbokeh.stacks.focal_stack import FocalStack


@dataclass(frozen=True)
class LeftOut:
    """A slice predicted from the others: linear PSNR in dB, clipped to [0, 1], without and with residuals, and of the nearest slice."""

    index: int
    focus_distance_m: float
    rendered_db: float
    with_residuals_db: float
    nearest_slice_db: float


def leave_one_out(stack: FocalStack, renderer: Renderer, most: int | None = None) -> Iterator[LeftOut]:
    """Predict each slice but the first and the last from the others. The all-in-focus picture has seen it, as in use it has not.

    most: so many slices at most, evenly taken; None for all.
    """
    plain, full = Refocusing(stack, renderer, residuals=False), Refocusing(stack, renderer)
    order = sorted(range(len(stack)), key=lambda index: 1.0 / float(stack.slices[index].focus_distance_m or np.inf))
    inner = range(1, len(order) - 1)
    for place in inner if most is None or len(inner) <= most else np.linspace(1, len(order) - 2, most).round().astype(int):
        before, index, after = order[place - 1 : place + 2]
        truth, focus_m = stack.slice_rgb(index), float(stack.slices[index].focus_distance_m or np.inf)
        mask = stack.slice_masks(index).valid
        nearest = max(psnr(stack.slice_rgb(other), truth, mask=mask) for other in (before, after))
        predicted = [psnr(way.slice_at(focus_m, leave_out=index), truth, mask=mask) for way in (plain, full)]
        yield LeftOut(
            index=index, focus_distance_m=focus_m, rendered_db=predicted[0], with_residuals_db=predicted[1], nearest_slice_db=nearest
        )
