"""The slices of several focal stacks, one after the other, as the fit sees them."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mrbokeh.lens_measuring.fitting.stack_equations import SliceView, known_pixels, smoothed_coc
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.errors import InputError


@dataclass
class StackSlices:
    """All slices of all stacks; pictures that a stack's slices share are kept while it is read."""

    stacks: tuple[FocalStack, ...]
    longest: int
    _of_stack: dict[int, tuple[np.ndarray, ...]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, stacks: Sequence[FocalStack]) -> "StackSlices":
        """Raises InputError where pictures of a stack are not registered, merged and metric."""
        for stack in stacks:
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
        """Width and height of the first stack."""
        height, width = self.stacks[0].depth_m().shape
        return width, height

    def place(self, number: int) -> tuple[FocalStack, int]:
        """The stack and slice of a number."""
        for stack in self.stacks:
            if number < len(stack):
                return stack, number
            number -= len(stack)
        raise IndexError(number)

    def view(self, number: int) -> SliceView:
        stack, index = self.place(number)
        if id(stack) not in self._of_stack:
            self._of_stack = {id(stack): (stack.all_in_focus(), stack.depth_m(), stack.depth_confidence())}
        sharp, depth_m, confidence = self._of_stack[id(stack)]
        known = known_pixels(confidence, stack.slice_masks(index), stack.exclusions()) & (depth_m > 0.0)
        return SliceView(sharp, stack.slice_rgb(index), smoothed_coc(stack.coc_px(index, depth_m), confidence), known)


def largest_diameter_px(stacks: Sequence[FocalStack]) -> float:
    """The largest circle of confusion of any slice; 0 without stacks."""
    maps = (np.abs(stack.coc_px(index, depth_m)) for stack in stacks for depth_m in [stack.depth_m()] for index in range(len(stack)))
    return max((float(each.max()) for each in maps), default=0.0)
