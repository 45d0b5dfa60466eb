"""One slice that no network was trained on: what is known of it, and itself as the truth."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack
from training.dataset import Pair, PairSet
from training.stacks import stack_name


@dataclass(frozen=True)
class UnseenSlice:
    """pair: what networks get, with the truth. lens: gives the pair's circles of confusion from depth_m, in metres.
    saturated: where the photograph says only "at least that much". nearest: where it was held out of its stack, the slice of the
    nearest focus that was not."""

    stack: str
    index: int
    pair: Pair
    lens: Lens
    depth_m: Float32[np.ndarray, "height width"]
    saturated: Bool[np.ndarray, "height width"]
    nearest: Float32[np.ndarray, "height width 3"] | None = None

    @property
    def label(self) -> str:
        return f"{self.stack} slice {self.index}"

    @property
    def counted(self) -> Bool[np.ndarray, "height width"]:
        """Pixels whose truth is known."""
        return self.pair.weight > 0

    def focused_at(self, focus_distance_m: float) -> "UnseenSlice":
        """The same view with another focus; its target and saturation are still those of the slice."""
        lens = self.lens.focused_at(focus_distance_m)
        coc_px = lens.coc_px(self.depth_m, self.depth_m.shape[1]).astype(np.float32)
        return replace(self, lens=lens, pair=replace(self.pair, coc_px=coc_px))


def unseen_slice(pairs: PairSet, index: int) -> UnseenSlice:
    """Read what belongs to the pair at that index of the set."""
    stack, slice_index = pairs.keys[index]
    saturated = stack.slice_masks(slice_index).saturated
    nearest = _nearest(stack, slice_index, pairs.left_out(stack))
    return UnseenSlice(stack_name(stack), slice_index, pairs[index], _lens(stack, slice_index), stack.depth_m(), saturated, nearest)


def _nearest(stack: FocalStack, index: int, others: Sequence[int]) -> Float32[np.ndarray, "height width 3"] | None:
    if not others:
        return None
    dioptres = [1.0 / (distance or np.inf) for distance in stack.focus_distances_m]
    return stack.slice_rgb(min(others, key=lambda other: abs(dioptres[other] - dioptres[index])))


def _lens(stack: FocalStack, index: int) -> Lens:
    """The lens of the slice, opened by as much as registration enlarged its blur."""
    lens = stack.lens_of(index)
    return replace(lens, f_number=lens.f_number / stack.slices[index].scale)
