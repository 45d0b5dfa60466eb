"""A slice that no network was trained on, with its data and itself as the truth, and masks of its informative pixels.

The masks mark pixels near depth edges, on their sharp side, and in the discs of highlights.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.images.image_metrics import depth_edge_mask
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack
from training.data.dataset import Pair, PairSet
from training.data.stacks import stack_name

EDGE_STEP_PX = 2.0
"""An edge is where the circle of confusion of neighbouring pixels differs by more."""
SHARP_PX = 2.0
"""What has a smaller circle of confusion is sharp."""
WHITE = 1.0
LEAST_DISC_PX = 3.0
LEAST_LIGHT = 0.05
"""A disc ends where it brings less radiance."""
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class UnseenSlice:
    """One unseen slice.

    pair: the networks' input, with the truth. lens: gives the pair's circles of confusion from depth_m, in metres.
    saturated: where the photograph is only a lower bound. nearest: the slice of the nearest focus that was trained on, if this one
    was held out of its stack.
    """

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
        """Return the pixels whose truth is known."""
        return self.pair.weight > 0

    def focused_at(self, focus_distance_m: float) -> "UnseenSlice":
        """Return the view with another focus; its target and saturation are still those of the slice."""
        lens = self.lens.focused_at(focus_distance_m)
        coc_px = lens.coc_px(self.depth_m, self.depth_m.shape[1]).astype(np.float32)
        return replace(self, lens=lens, pair=replace(self.pair, coc_px=coc_px))


def unseen_slice(pairs: PairSet, index: int) -> UnseenSlice:
    """Read the pair at that index of the set with its lens and depth."""
    stack, slice_index = pairs.keys[index]
    assert isinstance(stack, FocalStack), "blur pairs are not evaluated"
    saturated = stack.slice_masks(slice_index).saturated
    nearest = _nearest(stack, slice_index, pairs.left_out(stack))
    return UnseenSlice(
        stack=stack_name(stack),
        index=slice_index,
        pair=pairs[index],
        lens=_lens(stack, slice_index),
        depth_m=stack.depth_m(),
        saturated=saturated,
        nearest=nearest,
    )


def _nearest(stack: FocalStack, index: int, others: Sequence[int]) -> Float32[np.ndarray, "height width 3"] | None:
    if not others:
        return None
    dioptres = [1.0 / (distance or np.inf) for distance in stack.focus_distances_m]
    return stack.slice_rgb(min(others, key=lambda other: abs(dioptres[other] - dioptres[index])))


def _lens(stack: FocalStack, index: int) -> Lens:
    """Return the lens of the slice, opened by as much as registration enlarged its blur."""
    lens = stack.lens_of(index)
    return replace(lens, f_number=lens.f_number / stack.slices[index].scale)


def edge_band(seen: UnseenSlice) -> Mask:
    """Mark counted pixels within half of the largest circle of confusion of a depth edge, as far as its blur can reach."""
    reach_px = max(1, int(np.ceil(np.abs(seen.pair.coc_px[seen.counted]).max(initial=0.0) / 2.0)))
    step_dioptres = EDGE_STEP_PX / seen.lens.coc_px_per_dioptre(seen.depth_m.shape[1])
    return depth_edge_mask(seen.depth_m, reach_px, step_dioptres) & seen.counted


def sharp_side(seen: UnseenSlice) -> Mask:
    """Mark the part of the band that is in focus, over which light of the other side may spill."""
    return edge_band(seen) & (np.abs(seen.pair.coc_px) <= SHARP_PX)


def highlight_discs(seen: UnseenSlice) -> Mask:
    """Mark counted pixels reached by light above white from pixels blurred by at least LEAST_DISC_PX."""
    from mrbokeh.renderers.scatter_reference import scatter

    excess = np.maximum(seen.pair.all_in_focus.max(axis=2) - WHITE, 0.0).astype(np.float64)
    excess[np.abs(seen.pair.coc_px) < LEAST_DISC_PX] = 0.0
    if not excess.any():
        return np.zeros_like(seen.counted)
    light = scatter(excess[..., None], seen.pair.coc_px, Aperture.disc())[..., 0]
    return (light >= LEAST_LIGHT) & seen.counted
