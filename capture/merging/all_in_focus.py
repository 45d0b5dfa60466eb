"""The all-in-focus picture: every pixel from the slice in which it is sharp."""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Float32

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]


def slice_weight(focus_index: Plane, index: int) -> Plane:
    """How much slice `index` gives to each pixel: all near its own focus, crossing over half way to the next slice.

    The weights of all slices sum to 1. The cross-over takes half a step, where both slices are about equally sharp,
    so that it halves the noise there and leaves no seam.
    """
    distance = np.abs(focus_index - np.float32(index))
    return np.clip((0.75 - distance) / 0.5, 0.0, 1.0).astype(np.float32)


def all_in_focus(registered: Iterable[Rgb], focus_index: Plane) -> Rgb:
    """Blend of registered slices in linear light; slices are read one at a time."""
    blended = np.zeros((*focus_index.shape, 3), np.float32)
    for index, rgb in enumerate(registered):
        blended += slice_weight(focus_index, index)[..., None] * rgb
    return blended
