"""Colour of pixels in which some channels of the sensor are full: neutral instead of the tint of the white balance.

A full channel reads its white balance multiplier, whatever light there was: a white lamp turns magenta, because green has
the smallest multiplier. The light was at least as bright as the brightest channel says, and most lights are near white.
"""

import numpy as np
from jaxtyping import Float32

NEARLY_FULL = 0.95
_ROWS_AT_ONCE = 256


def neutral_where_full(
    camera_rgb: Float32[np.ndarray, "height width 3"], ceilings: tuple[float, float, float]
) -> Float32[np.ndarray, "height width 3"]:
    """White-balanced camera RGB with full channels raised to the brightest channel of their pixel.

    ceilings: what a full red, green and blue read (the white balance multipliers). From 95 % of its ceiling on a channel
    moves over smoothly, so that demosaicing leaves no seam. Coloured lights, whose other channels are not full, keep their hue.
    """
    result = np.empty_like(camera_rgb)
    # Strips, because the steps between take several times the memory of what they are made from.
    for first in range(0, len(camera_rgb), _ROWS_AT_ONCE):
        rows = camera_rgb[first : first + _ROWS_AT_ONCE]
        fullness = np.clip((rows / np.asarray(ceilings, np.float32) - NEARLY_FULL) / (1.0 - NEARLY_FULL), 0.0, 1.0)
        result[first : first + _ROWS_AT_ONCE] = rows + fullness * (rows.max(axis=2, keepdims=True) - rows)
    return result
