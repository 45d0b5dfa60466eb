"""Which pixels of a slice count: those whose depth and radiance are known and where nothing moved."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from training.settings import TrainSettings
from training.slice_rows import REASONS, SliceRows

# Nobody knows what the network should give there, so neither loss nor score counts them.
# "saturated" of the exclusion masks means saturated in any slice; a light that is full where it is sharp is well measured in the discs
# of other slices, so each slice has its own mask. Saturated targets pull: counted as recorded they cost 7 to 8 dB on a traced still life
# with lights (gated form, held-out view against its unclipped truth), or with a modelled white of the sensor 2 dB or nothing. Leaving
# them out of all slices instead of their own is 0.1 to 0.5 dB worse where nothing is saturated, 0.7 to 0.9 dB better over all pixels.
_LOW_CONFIDENCE = "low_confidence"


@dataclass(frozen=True)
class Counting:
    """least_confidence: pixels with less trustworthy depth do not count, nor those of the mask low_confidence; 0 counts all.
    saturation: pixels of a slice at or above this radiance do not count; None sets no such limit.
    saturated: whether pixels count in whose slice the sensor was full.
    one_sided: they count, but only where the result is darker than the slice, which is what a full photosite tells.
    """

    least_confidence: float = 0.1
    saturation: float | None = None
    saturated: bool = False
    one_sided: bool = False


WHERE_TRUTH_IS_KNOWN = Counting(least_confidence=0.0, saturated=True)


def counting_of(settings: TrainSettings) -> Counting:
    """What counts in a training run."""
    return Counting(
        settings.least_confidence,
        settings.saturation,
        saturated=settings.sensor_white is not None,
        one_sided=settings.saturated == "one_sided",
    )


def pixel_weight(read: SliceRows, counting: Counting) -> Float32[np.ndarray, "height width"]:
    """(H, W): 1 where the pixel counts, else 0."""
    exclusions = read.shared.exclusions
    counted = (read.shared.confidence >= counting.least_confidence) & read.valid
    for reason in REASONS:
        if reason in exclusions and (reason != _LOW_CONFIDENCE or counting.least_confidence > 0):
            counted &= ~exclusions[reason]
    if not (counting.saturated or counting.one_sided):
        counted &= ~read.saturated
    if counting.saturation is not None:
        counted &= read.target.max(axis=2) < counting.saturation
    return counted.astype(np.float32)
