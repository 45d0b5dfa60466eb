"""Does a result stay calm while the focus moves? Second differences in time along a pull against those of the truth.

Where a stack is a fine pull itself, its slices are the truth. Of others, frames are made between the focus distances of two
neighbouring slices and compared with the polygon renderer, the fast twin of the scatter reference (its own flicker there is that of the
reference to 3 %: 2.7e-4, rms of the second difference over 4, on the desk of the demo).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.image_metrics import flicker
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.console import track
from training.dataset import PairSet
from training.evaluation.methods import Method, renderer_method
from training.evaluation.unseen_slice import UnseenSlice, unseen_slice
from training.weights import WHERE_TRUTH_IS_KNOWN

FRAMES = 8
FINE_STEP_PX = 1.5
LEAST_FRAMES = 5
REFERENCE_RENDERER = "polygon"

Image = Float32[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class FocusPull:
    """frames: the focus moving on by even steps. truth: (H, W, 3) of each, masked as `shown` does; against: what it is, in words."""

    frames: tuple[UnseenSlice, ...]
    truth: tuple[Image, ...]
    against: str

    def flicker_of(self, method: Method) -> float:
        """Radiance, 0 for a result that is as calm as the truth (mrbokeh.images.image_metrics.flicker)."""
        return flicker([shown(method.blur(frame), frame) for frame in self.frames], self.truth)


def shown(picture: Image, frame: UnseenSlice) -> Image:
    """Pixels that do not count are black, in the results as in the truth."""
    return picture * frame.pair.weight[..., None]


def focus_pull(stack: FocalStack, frames: int = FRAMES) -> FocusPull:
    """The stack itself where it is fine, else `frames` between the two slices in its middle."""
    pairs = PairSet([stack], WHERE_TRUTH_IS_KNOWN, cache_mib=0)
    order = sorted(range(len(stack)), key=lambda index: 1.0 / (stack.slices[index].focus_distance_m or np.inf))
    if is_fine(stack):
        slices = tuple(unseen_slice(pairs, index) for index in order)
        return FocusPull(slices, tuple(shown(each.pair.target, each) for each in slices), "its own slices")
    return _made_pull([unseen_slice(pairs, index) for index in order[(len(order) - 1) // 2 :][:2]], frames)


def is_fine(stack: FocalStack) -> bool:
    """Enough slices, and from one to the next the circles of confusion change by FINE_STEP_PX at most."""
    dioptres = np.sort([1.0 / (each.focus_distance_m or np.inf) for each in stack.slices])
    if len(dioptres) < LEAST_FRAMES:
        return False
    width_px = stack.depth_m().shape[1]
    return float(np.diff(dioptres).max()) * stack.coc_px_per_dioptre(0, width_px) <= FINE_STEP_PX


def _made_pull(ends: Sequence[UnseenSlice], frames: int) -> FocusPull:
    """Even steps in dioptres from the first slice's focus to the last's; the lens and the pixels that count are the first's."""
    dioptres = np.linspace(1.0 / ends[0].lens.focus_distance_m, 1.0 / ends[-1].lens.focus_distance_m, frames)
    moving = tuple(ends[0].focused_at(float(1.0 / each) if each > 0 else np.inf) for each in dioptres)
    reference = renderer_method(REFERENCE_RENDERER)
    truth = tuple(shown(reference.blur(frame), frame) for frame in moving)
    return FocusPull(moving, truth, f"the {REFERENCE_RENDERER} renderer between {ends[0].label} and {ends[-1].index}")


def flickers(methods: Sequence[Method], pull: FocusPull) -> dict[str, float]:
    return {each.name: pull.flicker_of(each) for each in track(methods, "focus pull")}
