"""What a picture does not show: the background behind the edges of what is near, filled in from the pixels beside it.

The lens looks past an edge by half the difference of the two circles of confusion; no farther is anything filled in.
Colour and depth come from the nearest pixel that lies behind. Lights are left out, or a single lamp beside an edge would
shine twice.
"""

import numpy as np
from jaxtyping import Bool, Float32

_STEP_PX = 1.0  # less than this difference of circles of confusion is one surface
_SWEEPS = 2
_RIM_PX = 2
_LIGHT_OVER_SURROUNDINGS = 4.0


def hidden_background(
    values: Float32[np.ndarray, "height width channels"], coc_px: Float32[np.ndarray, "height width"]
) -> tuple[Float32[np.ndarray, "height width channels"], Float32[np.ndarray, "height width"]]:
    """The sheet behind an opaque one: premultiplied R, G, B, coverage (0 or 1), others, and its circles of confusion.

    values: (H, W, 4 + E) with coverage 1 everywhere; coc_px: (H, W) signed diameters.
    """
    from mrbokeh._hidden_background_numba import nearest_behind, pure_neighbours

    seed_y, seed_x = nearest_behind(coc_px, *pure_neighbours(coc_px, _STEP_PX, _RIM_PX), _STEP_PX, _SWEEPS)
    filled = seed_y >= 0
    behind, behind_coc_px = np.zeros_like(values), np.zeros_like(coc_px)
    if filled.any():
        seeds = seed_y[filled], seed_x[filled]
        behind[filled] = without_lights(values)[seeds]
        behind_coc_px[filled] = coc_px[seeds]
    return behind, behind_coc_px


def lights(rgb: Float32[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
    """Pixels several times brighter than the median of the 5x5 pixels around them."""
    brightest = np.ascontiguousarray(rgb.max(axis=2))
    return brightest > _LIGHT_OVER_SURROUNDINGS * _median(brightest)


def without_lights(values: Float32[np.ndarray, "height width channels"]) -> Float32[np.ndarray, "height width channels"]:
    """The picture with the median of the surroundings in place of lights and their rims."""
    from cv2 import dilate

    lit = dilate(lights(values[..., :3]).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    if not lit.any():
        return values
    dark = values.copy()
    for channel in range(3):
        dark[lit, channel] = _median(_median(np.ascontiguousarray(values[..., channel])))[lit]
    return dark


def _median(channel: Float32[np.ndarray, "height width"]) -> Float32[np.ndarray, "height width"]:
    from cv2 import medianBlur

    return medianBlur(channel, 5)
