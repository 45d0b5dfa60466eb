"""What a picture does not show: the background behind the edges of what is near, and how edge pixels mix the two.

A pixel beside something nearer holds some of its colour (antialiasing), though its depth is one or the other: such rims
would stay behind as sharp ghosts of a blurred wire, and a lamp's as a bright dot. They are taken apart. The lens looks past
an edge by half the difference of the two circles of confusion; no farther is anything filled in. Lights are no source
for it, or a single lamp beside an edge would shine twice.
"""

from concurrent.futures import ThreadPoolExecutor
from os import cpu_count

import numpy as np
from jaxtyping import Bool, Float32

_STEP_PX = 1.0  # less than this difference of circles of confusion between neighbours is one surface
_SURFACE_PX = 2.0  # the same, for pixels some way apart
_RIM_PX = 3
_BAND_ROWS = 64
_LIGHT_OVER_SURROUNDINGS = 4.0

Values = Float32[np.ndarray, "height width channels"]
Plane = Float32[np.ndarray, "height width"]


def apart(values: Values, coc_px: Plane) -> tuple[tuple[Values, Plane], tuple[Values, Plane]]:
    """An opaque picture as what is in front, with soft rims, and what lies behind its edges; each with its circles of confusion.

    values: (H, W, 4 + E) premultiplied R, G, B, coverage 1, others; coc_px: (H, W) signed diameters.
    """
    from mrbokeh._hidden_background_numba import interpolate, nearest_behind, pure_neighbours, rims, snapped, unmix_rims

    lit = lights(values[..., :3])
    coc_px = snapped(coc_px, lit, _STEP_PX)
    rim = rims(coc_px, _STEP_PX)
    front, front_coc_px = values, coc_px
    behind, behind_coc_px = np.zeros_like(values), np.zeros_like(coc_px)
    if not rim.any():
        return (front, front_coc_px), (behind, behind_coc_px)
    pure = ~(rim | lit)
    pure_y, pure_x = pure_neighbours(coc_px, pure, _STEP_PX, _RIM_PX)
    seed_y, seed_x = nearest_behind(coc_px, rim, pure_y, pure_x, _STEP_PX)
    seeded_rim = rim & (pure_y >= 0)
    seed_y[seeded_rim], seed_x[seeded_rim] = pure_y[seeded_rim], pure_x[seeded_rim]
    bands = [(top, min(top + _BAND_ROWS, len(values))) for top in range(0, len(values), _BAND_ROWS)]
    with ThreadPoolExecutor(cpu_count() or 1) as pool:
        list(pool.map(lambda band: interpolate(behind, behind_coc_px, values, coc_px, pure, seed_y, seed_x, _SURFACE_PX, *band), bands))
    front, front_coc_px = values.copy(), coc_px.copy()
    unmix_rims(front, front_coc_px, values, coc_px, behind, seeded_rim, lit, _STEP_PX)
    return (front, front_coc_px), (behind, behind_coc_px)


def without_lights(values: Values) -> Values:
    """The picture with the median of the surroundings in place of lights."""
    from cv2 import medianBlur

    lit = lights(values[..., :3])
    if not lit.any():
        return values
    dark = values.copy()
    for channel in range(3):
        dark[lit, channel] = medianBlur(np.ascontiguousarray(values[..., channel]), 5)[lit]
    return dark


def lights(rgb: Float32[np.ndarray, "height width 3"]) -> Bool[np.ndarray, "height width"]:
    """Pixels several times brighter than the median of the 5x5 pixels around them."""
    from cv2 import BORDER_REPLICATE, erode

    from mrbokeh._hidden_background_numba import far_over_median

    brightest = np.maximum(np.maximum(rgb[..., 0], rgb[..., 1]), rgb[..., 2])
    darkest_around = erode(brightest, np.ones((5, 5), np.uint8), borderType=BORDER_REPLICATE)
    return far_over_median(brightest, brightest > _LIGHT_OVER_SURROUNDINGS * darkest_around, _LIGHT_OVER_SURROUNDINGS)
