"""A photograph, near light, virtual light and rays through all of them put together: what each pixel shows of the three parts."""

import numpy as np
from jaxtyping import Float32, Float64, Int64

from mrbokeh.compositing.base import Inserted
from mrbokeh.compositing.light_points import far_lights, virtual_lights
from mrbokeh.compositing.plate import Plate
from mrbokeh.compositing.pupil_shares import PupilMeans, Rays
from mrbokeh.images.layer import Layer

LEAST_LIGHT = np.float32(1e-5)
"""Less coverage or light than this is rounding of the renderer, not light of a layer."""
_ALL = 1e-4
_MOST_NEAR = 0.995
_ROUND = 1e-9
_MOST_CHANGE, _LEAST_PART = 3.0, 0.02
_UNEXPLAINED = 0.5

Plane = Float32[np.ndarray, "height width"]
Colours = Float32[np.ndarray, "places 3"]
Shares = Float32[np.ndarray, " places"]
Exact = Float64[np.ndarray, " places"]
ExactColours = Float64[np.ndarray, "places 3"]
Places = Int64[np.ndarray, " places"]


def put_together(plate: Plate, near: Layer, blurred: Layer, rays: Rays) -> Inserted:
    """The picture, from what near and virtual light do by themselves."""
    arrives = (blurred.alpha > LEAST_LIGHT) | (np.abs(blurred.rgb).max(axis=2) > LEAST_LIGHT)
    alone = arrives & (near.alpha <= _ALL)
    simple = alone & ((blurred.alpha >= 1.0 - _ALL) | rays.one_far_colour)
    virtual_rgb = np.where(simple[..., None], np.maximum(blurred.rgb, 0.0), np.float32(0.0))
    virtual_alpha = np.where(simple, np.maximum(blurred.alpha, 0.0), np.float32(0.0))
    hides = np.where(virtual_alpha > LEAST_LIGHT, np.minimum(virtual_alpha, 1.0), np.float32(0.0))
    photo_rgb = (np.float32(1.0) - hides)[..., None] * plate.rgb
    places = np.flatnonzero(arrives & ~simple & (_least_around(near.alpha) < 1.0 - _ALL))
    at = np.unravel_index(places, blurred.alpha.shape)
    photo_rgb[at], virtual_rgb[at], virtual_alpha[at] = _shared(plate.rgb[at], near, blurred, rays, places)
    seen = np.divide(virtual_alpha, blurred.alpha, out=np.zeros_like(virtual_alpha), where=blurred.alpha > LEAST_LIGHT)
    extra = {name: values * seen[..., None] for name, values in blurred.extra.items()}
    return Inserted(photo_rgb, Layer(virtual_rgb, virtual_alpha, blurred.depth_m, extra))


def _shared(photo_rgb: Colours, near: Layer, blurred: Layer, rays: Rays, places: Places) -> tuple[Colours, Colours, Shares]:
    """(photograph left, virtual light, its share of the pupil) at places where near, virtual and far may all be seen."""
    means = rays.means(places)
    near_share = np.minimum(near.alpha.reshape(-1)[places].astype(np.float64), _MOST_NEAR)
    covered = np.clip(blurred.alpha.reshape(-1)[places].astype(np.float64), 0.0, 1.0)
    free = 1.0 - near_share
    share = np.clip(free * covered + means.f_a - means.f * means.a, np.maximum(covered - near_share, 0.0), np.minimum(covered, free))
    light = _virtual_light(blurred, rays, places, means, free)
    far, stays = _far_light(photo_rgb, near, rays, places, means, free, share)
    hidden = (share <= LEAST_LIGHT)[:, None]
    left = np.where(hidden, photo_rgb, photo_rgb - far * (1.0 - stays))
    light = np.where(hidden & (covered > LEAST_LIGHT)[:, None], 0.0, np.maximum(light, 0.0))
    return left.astype(np.float32), light.astype(np.float32), share.astype(np.float32)


def _virtual_light(blurred: Layer, rays: Rays, places: Places, means: PupilMeans, free: Exact) -> ExactColours:
    """What gets past the near things: surfaces by the part of the pupil they leave and the covariance, lights one by one."""
    wanted = np.zeros(blurred.alpha.shape, np.bool_)
    wanted.reshape(-1)[places] = True
    own = virtual_lights(rays, wanted)
    alone, past = own.one.reshape(-1, 3)[places], own.both.reshape(-1, 3)[places]
    surfaces = free[:, None] * (blurred.rgb.reshape(-1, 3)[places] - alone)
    return surfaces + means.f_virtual - means.f[:, None] * means.virtual + past


def _far_light(
    photo_rgb: Colours, near: Layer, rays: Rays, places: Places, means: PupilMeans, free: Exact, share: Exact
) -> tuple[ExactColours, ExactColours]:
    """(far light in the photograph, the part of it that the virtual surface leaves visible)."""
    near_rgb = near.rgb.reshape(-1, 3)[places]
    surfaces = means.f_far * (free / np.maximum(means.f, _ROUND))[:, None]
    left_over = np.full_like(near.alpha, np.nan)
    left_over.reshape(-1)[places] = (photo_rgb - near_rgb - surfaces).astype(np.float32).sum(axis=1)
    bright = far_lights(rays, left_over)
    before, after = bright.one.reshape(-1, 3)[places], bright.both.reshape(-1, 3)[places]
    stays = np.clip((1.0 - share / free)[:, None] * _colour_change(means), 0.0, 1.0)
    far = surfaces + before
    return _explained(photo_rgb, near_rgb, far), np.clip((surfaces * stays + after) / np.maximum(far, _ROUND), 0.0, 1.0)


def _least_around(alpha: Plane) -> Plane:
    """The least of 3x3 pixels: beside a rim a photograph may show more of what is behind than the sharp picture says."""
    from cv2 import erode

    return np.asarray(erode(alpha, np.ones((3, 3), np.uint8)), np.float32)


def _colour_change(means: PupilMeans) -> Colours:
    """Mean far colour in the part of the pupil that looks past near and virtual, over that past the near alone."""
    change = means.past_far * means.f[:, None] / np.maximum(means.f_far * means.past[:, None], _ROUND)
    enough = (means.past > _LEAST_PART)[:, None]
    return np.where(enough, np.clip(change, 1.0 / _MOST_CHANGE, _MOST_CHANGE), np.float32(1.0))


def _explained(photo_rgb: Colours, near_rgb: Colours, far_rgb: ExactColours) -> ExactColours:
    """How much of the photograph is far light: what was blurred anew, and what that leaves over, shared by the squares of both."""
    left_over = photo_rgb - near_rgb - far_rgb
    far_share = far_rgb**2 / np.maximum(far_rgb**2 + near_rgb**2, _ROUND)
    far_share = np.where(left_over > _UNEXPLAINED * (near_rgb + far_rgb), 1.0, far_share)
    return np.clip(far_rgb + left_over * far_share, 0.0, np.maximum(photo_rgb, 0.0))
