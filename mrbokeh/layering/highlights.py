"""Highlights of a picture: pixels far brighter than those around them."""

import numpy as np
from jaxtyping import Bool, Float32

LIGHT_OVER_SURROUNDINGS = np.float32(4.0)

Values = Float32[np.ndarray, "height width channels"]
Mask = Bool[np.ndarray, "height width"]


def find_highlights(values: Values) -> Mask:
    """Return a mask of the pixels several times brighter than the median of the 5x5 pixels around them. values: R, G, B and any others."""
    lit = np.empty(values.shape[:2], np.bool_)
    mark_highlights(lit, np.ascontiguousarray(values), 0, len(lit))
    return lit


def mark_highlights(lit: Mask, values: Values, top: int, bottom: int) -> None:
    """Set rows top to bottom of a mask, as `find_highlights` does for all."""
    from mrbokeh.layering._pixels_numba import mark_rows

    mark_rows(lit, values, LIGHT_OVER_SURROUNDINGS, top, bottom)


def without_highlights(values: Values) -> Values:
    """Return the picture with the median of the surroundings in place of highlights; the same array if there are none."""
    from cv2 import medianBlur

    lit = find_highlights(values)
    if not lit.any():
        return values
    dark = values.copy()
    for channel in range(3):
        dark[lit, channel] = medianBlur(np.ascontiguousarray(values[..., channel]), 5)[lit]
    return dark
