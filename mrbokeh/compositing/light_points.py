"""Lights followed ray by ray: at every place of its blur a light is seen through one point of the pupil, which is hidden or not.

Few rays per pixel would miss it, and a blurred coverage would dim its whole disc where the truth cuts it. Only lights whose discs come
to a pixel that is asked for are followed.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.compositing.near_and_far import Lights
from mrbokeh.compositing.pupil_points import pupil_points
from mrbokeh.compositing.pupil_shares import Rays
from mrbokeh.layering.lit_pixels import lights

_LEAST_POINTS, _MOST_POINTS = 64, 16384
_POINTS_PER_PX = 4.0
_DISC_POINTS, _LEAST_DISC_PX, _MOST_GAIN, _LEAST_SUM = 256, 1.5, 50.0, 1e-6

Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class LightThrough:
    """Light of single bright pixels (H, W, 3) as it arrives past one layer, and past that and another."""

    one: Float32[np.ndarray, "height width 3"]
    both: Float32[np.ndarray, "height width 3"]


def far_lights(rays: Rays, left_over: Plane) -> LightThrough:
    """Past the near things, and past near and virtual ones, where `left_over` is a number.

    left_over: light of the photograph (r + g + b) that surfaces do not explain, NaN where unknown. A light that the sharp picture
    shows half hidden or clipped gets the brightness of its disc there.
    """
    first, second = (rays.scene.near.alpha, rays.coc_px[0]), (rays.virtual.alpha, rays.coc_px[1])
    bright = _arriving(rays, rays.scene.lights, rays.coc_px[2], np.isfinite(left_over))
    dim = _followed(rays, bright, rays.coc_px[2], first, second)
    if len(bright.places) == 0:
        return dim
    brighter = _gains(rays, bright, left_over / np.maximum(dim.one.sum(axis=2), _LEAST_SUM))
    return _followed(rays, replace(bright, rgb=bright.rgb * brighter[:, None]), rays.coc_px[2], first, second)


def _arriving(rays: Rays, bright: Lights, coc_px: Plane, wanted: Mask) -> Lights:
    """Those lights whose discs come to a wanted pixel, or to one beside it."""
    from cv2 import integral

    (height, width), (rows, columns) = wanted.shape, np.unravel_index(bright.places, wanted.shape)
    farthest = max((aperture.unit_radius for _, aperture in rays.cells(bright.places)), default=0.0)
    half_px = np.ceil(0.5 * farthest * np.abs(coc_px[rows, columns])).astype(int) + 1
    counts = integral(wanted.astype(np.uint8))
    top, bottom = np.maximum(rows - half_px, 0), np.minimum(rows + half_px + 1, height)
    left, right = np.maximum(columns - half_px, 0), np.minimum(columns + half_px + 1, width)
    kept = counts[bottom, right] - counts[top, right] - counts[bottom, left] + counts[top, left] > 0
    return Lights(bright.places[kept], bright.rgb[kept], bright.depth_m[kept])


def _gains(rays: Rays, bright: Lights, ratio: Plane) -> Float32[np.ndarray, " lights"]:
    """Per light the median, over its disc, of how much more light there is than it gives."""
    height, width = ratio.shape
    gains = np.ones(len(bright.places), np.float32)
    for which, aperture in rays.cells(bright.places):
        xy = pupil_points(aperture, _DISC_POINTS)[:, :2]
        for index in which:
            row, column = divmod(int(bright.places[index]), width)
            centre_px, half_px = np.array([column + 0.5, row + 0.5]), 0.5 * float(rays.coc_px[2, row, column])
            x, y = np.floor(centre_px + xy * half_px).astype(int).T
            seen = ratio[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
            known = np.isfinite(seen)
            if abs(half_px) >= _LEAST_DISC_PX and known.sum() >= _DISC_POINTS // 8:
                gains[index] = np.clip(np.median(seen[known]), 1.0 / _MOST_GAIN, _MOST_GAIN)
    return gains


def virtual_lights(rays: Rays, wanted: Mask) -> LightThrough:
    """As if nothing hid them, and past the near things; where it is wanted."""
    places = np.flatnonzero(lights(rays.virtual_rgba))
    whole, dark = (each.reshape(-1, 4)[places, :3] for each in (rays.virtual_rgba, rays.virtual_without_lights))
    bright = _arriving(rays, Lights(places, whole - dark, np.zeros(len(places), np.float32)), rays.coc_px[1], wanted)
    nothing = (np.zeros_like(rays.virtual.alpha), rays.coc_px[0])
    return _followed(rays, bright, rays.coc_px[1], nothing, (rays.scene.near.alpha, rays.coc_px[0]))


def _followed(rays: Rays, bright: Lights, coc_px: Plane, first: tuple[Plane, Plane], second: tuple[Plane, Plane]) -> LightThrough:
    from mrbokeh.compositing._between_numba import follow

    width = coc_px.shape[1]
    one, both = np.zeros((*coc_px.shape, 3), np.float32), np.zeros((*coc_px.shape, 3), np.float32)
    for which, aperture in rays.cells(bright.places):
        pupil = pupil_points(aperture, _MOST_POINTS)
        for place, rgb in zip(bright.places[which], bright.rgb[which], strict=True):
            row, column = divmod(int(place), width)
            light_coc_px = float(coc_px[row, column])
            count = int(np.clip(_POINTS_PER_PX * light_coc_px**2, _LEAST_POINTS, _MOST_POINTS))
            light = (row, column, light_coc_px, float(rgb[0]), float(rgb[1]), float(rgb[2]))
            follow(one, both, light, *first, *second, pupil[:count])
    return LightThrough(one, both)
