"""Lights that the sensor could not hold: drawn anew in the all-in-focus picture with the flux and the place that their discs tell.

The size of a light comes from the slice in which it is sharpest: of discs with the known flux at the known place, the one that
explains what is seen there below saturation. Where discs tell no flux (large lamps, lights that overlap) the sharp pixels of
the light are raised to the flux of its widest disc instead.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from capture.merging.light_discs import LightDiscs
from capture.merging.lights import OVER_RANGE, Lights

Rgb = Float32[np.ndarray, "height width 3"]

CORE_SHARE = 0.7
# Radii of lights that are drawn as discs. Larger lamps, and those that saturated less, show their own shape and keep it.
RADII_PX = np.arange(0.0, 2.51, 0.125)
LARGEST_AREA_PX = 30.0
LARGEST_HELD_SHARE = 0.65
# A point light behind a low-pass filter covers about this; demosaicing of full pixels hides smaller differences, which
# count as much as this squared radiance per squared pixel of the radius.
USUAL_RADIUS_PX = 1.0
USUAL_WEIGHT = 10.0
SUBPIXELS = 8
MARGIN_PX = 3


@dataclass(frozen=True)
class _Patch:
    """The pixels around a light: their place in the picture, and its centre in subpixels of the patch."""

    box: tuple[slice, slice]
    distance_px: Float[np.ndarray, "height width"]
    centre_px: Float[np.ndarray, "2"]

    @classmethod
    def around(cls, xy_px: Float[np.ndarray, "2"], reach_px: int, shape: tuple[int, ...]) -> "_Patch":
        left, top = (max(int(each) - reach_px, 0) for each in xy_px)
        right, bottom = min(int(xy_px[0]) + reach_px + 1, shape[1]), min(int(xy_px[1]) + reach_px + 1, shape[0])
        y, x = np.mgrid[top:bottom, left:right] + 0.5
        return cls(np.s_[top:bottom, left:right], np.hypot(x - xy_px[0], y - xy_px[1]), xy_px - [left, top])

    def disc(self, radius_px: float) -> Float[np.ndarray, "height width"]:
        """The share of a disc's light in each pixel; below the grid of subpixels it is a point."""
        height, width = self.distance_px.shape
        y, x = (np.mgrid[: height * SUBPIXELS, : width * SUBPIXELS] + 0.5) / SUBPIXELS
        squared = (x - self.centre_px[0]) ** 2 + (y - self.centre_px[1]) ** 2
        inside = squared <= max(radius_px**2, float(squared.min()))
        return inside.reshape(height, SUBPIXELS, width, SUBPIXELS).mean(axis=(1, 3)) / inside.mean() / (height * width)


def with_light_energy(merged: Rgb, discs: LightDiscs, lights: Lights, sharpest: Rgb | None = None) -> Rgb:
    """The all-in-focus picture with all lights.

    sharpest: around each light the slice in which it is most concentrated; None: the picture was merged so.
    """
    from scipy.ndimage import find_objects

    restored, boxes = merged.copy(), find_objects(lights.zone, len(lights))
    sharpest = merged if sharpest is None else sharpest
    for light in range(len(lights)):
        believable = discs.believable(light)
        if believable.any() and _mostly_lost(light, believable, discs, lights):
            _draw(restored, sharpest, lights, discs, light, believable)
        else:
            _raise(restored, lights, discs, light, boxes[light])
    return restored


def _mostly_lost(light: int, believable: Bool[np.ndarray, " slices"], discs: LightDiscs, lights: Lights) -> bool:
    """A small light whose sharp pixels hold so little of its flux that they do not show its shape either."""
    held, flux = discs.flux[lights.sharpest[light], light].sum(), np.median(discs.flux[believable, light].sum(axis=1))
    return bool(lights.areas_px[lights.sharpest[light], light] < LARGEST_AREA_PX and held < LARGEST_HELD_SHARE * flux)


def _draw(restored: Rgb, sharpest: Rgb, lights: Lights, discs: LightDiscs, light: int, use: Bool[np.ndarray, " slices"]) -> None:
    """Replace what is left of a light by a disc with its flux, and its stray light by what surrounds it."""
    certainty = 1.0 / np.maximum(discs.variance_px2[use, light], 0.5)
    xy_px = np.average(discs.xy_px[use, light], axis=0, weights=certainty)
    flux = np.average(discs.flux[use, light], axis=0, weights=certainty)
    clear_px = 1.15 * np.sqrt(lights.areas_px[lights.sharpest[light], light] / np.pi) + 2.0
    patch = _Patch.around(xy_px, int(np.ceil(clear_px)) + MARGIN_PX, restored.shape)
    around = patch.distance_px > clear_px
    picture = restored[patch.box]
    surroundings = np.median(picture[around], axis=0)
    disc = patch.disc(_radius_px(sharpest[patch.box], patch, flux))
    stray = ~around & ((picture > picture[around].max(axis=0)) | (picture < picture[around].min(axis=0))).any(axis=2)
    picture[stray] = surroundings
    cover = (disc / disc.max())[..., None]
    picture[:] = (1.0 - cover) * picture + disc[..., None] * flux


def _radius_px(seen: Rgb, patch: _Patch, flux: Float[np.ndarray, "3"]) -> float:
    """The radius of the disc that explains what is seen of a light where nothing is full."""
    surroundings = np.median(seen[patch.distance_px > patch.distance_px.max() / 2], axis=0)
    unsaturated = np.minimum(seen, OVER_RANGE)

    def miss(radius_px: float) -> float:
        expected = np.minimum(surroundings + patch.disc(radius_px)[..., None] * flux, OVER_RANGE)
        return float(((expected - unsaturated) ** 2).sum() + USUAL_WEIGHT * (radius_px - USUAL_RADIUS_PX) ** 2)

    return float(min(RADII_PX, key=miss))


def _raise(restored: Rgb, lights: Lights, discs: LightDiscs, light: int, box: tuple[slice, slice]) -> None:
    """Raise the sharp pixels of a light by what all around it is brighter where its disc is wide: texture there cancels."""
    mine = (lights.zone[box] == light + 1) & lights.core[box]
    if not mine.any():
        return
    brightness = restored[box].max(axis=2)
    brightest = mine & (brightness >= CORE_SHARE * brightness[mine].max())
    believable = discs.believable(light)
    held = discs.zone_light[lights.sharpest[light], light]
    zone = np.median(discs.zone_light[believable, light], axis=0) if believable.any() else discs.zone_light[lights.widest[light], light]
    # Channels fill one by one: a lamp that has lost a third of its red may hold all of its blue.
    missing = np.maximum(zone - held, 0.0)
    restored[box][brightest] += (missing / np.count_nonzero(brightest)).astype(np.float32)
