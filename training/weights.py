"""Which pixels of a slice count: those whose depth and radiance are known and where nothing moved."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from mrbokeh.focal_stack import FocalStack

# Nobody knows what the network should give there, so neither loss nor score counts them.
# "saturated" of the exclusion masks means saturated in any slice; a light that is full where it is sharp is well measured in the discs
# of other slices, so each slice has its own mask. Saturated targets pull: counted as recorded they cost 7 to 8 dB on a traced still life
# with lights (gated form, held-out view against its unclipped truth), or with a modelled white of the sensor 2 dB or nothing. Leaving
# them out of all slices instead of their own is 0.1 to 0.5 dB worse where nothing is saturated, 0.7 to 0.9 dB better over all pixels.
_NO_TRUTH = ("moving", "border", "board")
_LOW_CONFIDENCE = "low_confidence"


@dataclass(frozen=True)
class Counting:
    """least_confidence: pixels with less trustworthy depth do not count, nor those of the mask low_confidence; 0 counts all.
    saturation: pixels of a slice at or above this radiance do not count; None sets no such limit.
    saturated: whether pixels count in whose slice the sensor was full.
    """

    least_confidence: float = 0.1
    saturation: float | None = None
    saturated: bool = False


WHERE_TRUTH_IS_KNOWN = Counting(least_confidence=0.0, saturated=True)


def pixel_weight(
    stack: FocalStack, index: int, target: Float32[np.ndarray, "height width 3"], counting: Counting
) -> Float32[np.ndarray, "height width"]:
    """(H, W): 1 where the pixel counts, else 0."""
    counted = stack.depth_confidence() >= counting.least_confidence
    masks, exclusions = stack.slice_masks(index), stack.exclusions()
    counted &= masks.valid
    for reason in (*_NO_TRUTH, *([_LOW_CONFIDENCE] if counting.least_confidence > 0 else [])):
        counted &= ~exclusions.get(reason, np.zeros_like(counted))
    if not counting.saturated:
        counted &= ~masks.saturated
    if counting.saturation is not None:
        counted &= target.max(axis=2) < counting.saturation
    return counted.astype(np.float32)
