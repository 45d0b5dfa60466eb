"""Slices of focal stacks, and blur pairs, as a fit sees them: one view after the other."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from mrbokeh.images.camera_rgb import SliceMasks
from mrbokeh.lens_measuring.fitting.blur_pairs import BlurPair
from mrbokeh.lens_measuring.fitting.stack_equations import LEAST_CONFIDENCE, Mask, Plane, SliceView, smoothed_coc
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.errors import InputError

_NO_TRUTH = ("moving", "border", "board")


def known_pixels(confidence: Plane, masks: SliceMasks, exclusions: Mapping[str, Mask]) -> Mask:
    """Return the pixels with a trusted depth whose light was measured."""
    known = (confidence >= LEAST_CONFIDENCE) & masks.valid & ~masks.saturated
    for reason in (*_NO_TRUTH, "low_confidence"):
        known &= ~exclusions.get(reason, np.zeros_like(known))
    return np.asarray(known)


@dataclass
class StackSlices:
    """Slices of all stacks, one after the other; pictures that a stack's slices share are kept while it is read. A pair is one slice."""

    stacks: tuple[FocalStack | BlurPair, ...]
    longest: int
    _of_stack: dict[int, tuple[np.ndarray, ...]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, stacks: Sequence[FocalStack | BlurPair]) -> "StackSlices":
        """Open stacks and pairs. Raises InputError if a stack is not registered, merged and metric."""
        for stack in stacks:
            if not isinstance(stack, FocalStack):
                continue
            if not stack.registered:
                raise InputError(
                    f"{stack.folder} is not registered, so its slices do not lie on its depth: run `mrbokeh capture merge` on it"
                )
            stack.depth_m()
            stack.stated_lens_of(0)
        return cls(tuple(stacks), max((len(stack) for stack in stacks), default=1))

    def __len__(self) -> int:
        return sum(len(stack) for stack in self.stacks)

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height of the first stack."""
        first = self.stacks[0]
        if not isinstance(first, FocalStack):
            return first.size
        height, width = first.depth_m().shape
        return width, height

    def place(self, number: int) -> tuple[FocalStack | BlurPair, int]:
        """Return the stack and slice of a number."""
        for stack in self.stacks:
            if number < len(stack):
                return stack, number
            number -= len(stack)
        raise IndexError(number)

    def view(self, number: int) -> SliceView:
        stack, index = self.place(number)
        if not isinstance(stack, FocalStack):
            return stack.view
        if id(stack) not in self._of_stack:
            self._of_stack = {id(stack): (stack.all_in_focus(), stack.depth_m(), stack.depth_confidence())}
        sharp, depth_m, confidence = self._of_stack[id(stack)]
        known = known_pixels(confidence, stack.slice_masks(index), stack.exclusions()) & (depth_m > 0.0)
        return SliceView(sharp, stack.slice_rgb(index), smoothed_coc(stack.coc_px(index, depth_m), confidence), known)


def largest_diameter_px(stacks: Sequence[FocalStack | BlurPair]) -> float:
    """Return the largest circle of confusion of any slice; 0 without stacks."""
    return max((_largest_px(stack) for stack in stacks), default=0.0)


def _largest_px(stack: FocalStack | BlurPair) -> float:
    if not isinstance(stack, FocalStack):
        return stack.largest_px
    depth_m = stack.depth_m()
    return max(float(np.abs(stack.coc_px(index, depth_m)).max()) for index in range(len(stack)))
