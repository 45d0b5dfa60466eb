"""A layer of moving things: one picture with motion channels where paths are straight, an accumulation where they are bent."""

from dataclasses import dataclass, replace

import numpy as np

from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import MOTION
from mrbokeh.scene import SceneRenderer
from mrbokeh.scene.moving_layers.accumulation import Rendering, accumulated
from mrbokeh.scene.moving_layers.filmed_scene import FilmedScene
from mrbokeh.scene.moving_layers.paths import FRACTIONS, Paths, paths_of
from mrbokeh.scene.moving_layers.rolling import rolled

_LEAST_SAMPLES = 8


@dataclass(frozen=True)
class MotionQuality:
    """most_bend_px: what paths may bend, or run unevenly, before pictures are averaged in place of one with straight paths.

    A body that turns by an angle a bends the path of a point at a radius of r pixels by r (1 - cos(a / 2)): half a pixel is 11
    degrees at 100 px, 3.6 degrees at 1000 px. most_samples: of averaged pictures; fewer where paths are shorter in pixels.
    """

    most_bend_px: float = 0.5
    most_samples: int = 64


_USUAL = MotionQuality()


def moving_layer(renderer: SceneRenderer, filmed: FilmedScene, time_s: float, quality: MotionQuality = _USUAL) -> Layer:
    """The scene as its camera sees it in the frame of a time, sharp but for motion, which stands in the layer's motion channels.

    mrbokeh's renderers draw it out before they blur it by the lens. Where nothing moves the layer is the renderer's own,
    without motion channels. Where paths bend by more than quality allows, where the scene's triangles change, or where a point
    passes the camera, the layer is `accumulated`: blurred already, without motion channels. Light does not change with the
    motion, and what comes into the frame only before or after the middle of the shutter is missing.
    """
    return followed(renderer.render, filmed, time_s, quality)


def followed(rendering: Rendering, filmed: FilmedScene, time_s: float, quality: MotionQuality = _USUAL) -> Layer:
    """`moving_layer` for anything that makes a layer with depth out of scene and camera."""
    filmed = filmed.remembering()
    shutter, middle_s = filmed.shutter, filmed.shutter.middle_s(time_s)
    span_s = shutter.exposure_s + abs(shutter.readout_s)
    layer = rendering(filmed.scene_at(middle_s), filmed.camera_at(middle_s))
    if span_s == 0.0 or filmed.is_still(tuple(middle_s + fraction * span_s for fraction in FRACTIONS)):
        return layer
    if not (layer.alpha > 0).any():
        return layer
    paths = paths_of(layer, filmed, middle_s, span_s)
    if paths is None or paths.bend_px > quality.most_bend_px:
        return accumulated(rendering, filmed, time_s, samples_for(paths, quality))
    if shutter.exposure_s > 0.0:
        layer = _with_motion(layer, paths, shutter.exposure_s / span_s)
    return rolled(layer, paths, span_s, shutter) if shutter.is_rolling else layer


def samples_for(paths: Paths | None, quality: MotionQuality) -> int:
    """As many pictures as the longest path has pixels, within bounds; the most where paths are unknown."""
    if paths is None:
        return quality.most_samples
    return min(max(int(np.ceil(paths.length_px)), _LEAST_SAMPLES), quality.most_samples)


def _with_motion(layer: Layer, paths: Paths, share: float) -> Layer:
    """`mrbokeh.layering.motion.with_motion` for a part of the paths' time, within their box alone."""
    motion_px = np.zeros((*layer.alpha.shape, 2), np.float32)
    motion_px[paths.box.where] = paths.motion_px * np.float32(share) * layer.alpha[paths.box.where][..., None]
    return replace(layer, extra={**layer.extra, MOTION: motion_px})
