"""The all-in-focus picture: every pixel from the slice in which it is sharp."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float32

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

NARROW_CROSSOVER = 0.5
# Up to this blur between neighbouring slices both are sharp enough to be mixed anywhere between them.
SHARP_STEP_COC_PX = 2.0


def crossover_of(step_coc_px: float) -> float:
    """Which share of a step to cross over in; step_coc_px: the circle of confusion of one slice's focus in the next slice."""
    return float(np.clip(SHARP_STEP_COC_PX / max(step_coc_px, 1e-6), NARROW_CROSSOVER, 1.0))


def slice_weight(focus_index: Plane, index: int, crossover: float = NARROW_CROSSOVER) -> Plane:
    """How much slice `index` gives to each pixel: all near its own focus, crossing over half way to the next slice.

    The weights of all slices sum to 1. The cross-over takes the given share of a step, where both slices are about equally
    sharp, so that it lessens the noise there and leaves no seam; 1 is linear interpolation.
    """
    distance = np.abs(focus_index - np.float32(index))
    return np.clip((0.5 - distance) / crossover + 0.5, 0.0, 1.0).astype(np.float32)


def all_in_focus(registered: Iterable[Rgb], focus_index: Plane, crossover: float = NARROW_CROSSOVER) -> Rgb:
    """Blend of registered slices in linear light by `slice_weight`; slices are read one at a time."""
    from capture.merging._blend_numba import add_weighted

    blended = np.zeros((*focus_index.shape, 3), np.float32)
    for index, rgb in enumerate(registered):
        add_weighted(blended, rgb, focus_index, float(index), crossover)
    return blended
