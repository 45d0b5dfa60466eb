"""Layers of moving objects and of their shadows.

Straight paths give one picture with motion channels, moved row by row for a rolling shutter; bent paths give the average of many
pictures.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float64

from mrbokeh.distortion.warping import resampled
from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import MOTION
from mrbokeh.layering.pixel_box import Box
from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Mesh, Scene, SceneRenderer
from mrbokeh.scene.moving_layers.filmed_scene import FilmedScene, ShutterTiming
from mrbokeh.scene.moving_layers.paths import FRACTIONS, Paths, paths_of
from mrbokeh.scene.virtual_scene import shadow_layer
from mrbokeh.system.errors import InputError

Rendering = Callable[[Scene, Camera], Layer]

_STEPS = 10
_CLOSE_PX = 0.01
_LEAST_SAMPLES = 8
_SAMPLES = 16


@dataclass(frozen=True)
class MotionQuality:
    """Limits between one picture with motion channels and an average.

    most_bend_px: largest deviation of a path from even motion before pictures are averaged. A body that turns by an angle a bends the
    path of a point at a radius of r pixels by r (1 - cos(a / 2)): half a pixel is 11 degrees at 100 px, 3.6 degrees at 1000 px.
    most_samples: number of averaged pictures; fewer if paths are shorter in pixels.
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
    """Return as many pictures as the longest path has pixels, within bounds; the most if paths are unknown."""
    if paths is None:
        return quality.most_samples
    return min(max(int(np.ceil(paths.length_px)), _LEAST_SAMPLES), quality.most_samples)


def _with_motion(layer: Layer, paths: Paths, share: float) -> Layer:
    """`mrbokeh.layering.motion.with_motion` for a part of the paths' time, within their box alone."""
    motion_px = np.zeros((*layer.alpha.shape, 2), np.float32)
    motion_px[paths.box.where] = paths.motion_px * np.float32(share) * layer.alpha[paths.box.where][..., None]
    return replace(layer, extra={**layer.extra, MOTION: motion_px})


@dataclass(frozen=True)
class ShadowCatcher:
    """A level catcher, and how dark its shadow is where no light arrives (0 to 1)."""

    mesh: Mesh
    strength: float = 1.0


def moving_shadow_layer(
    renderer: SceneRenderer, filmed: FilmedScene, time_s: float, catcher: ShadowCatcher, samples: int = _SAMPLES
) -> Layer:
    """The layer of a scene's shadow in the frame of a time.

    Where only the camera moves, the shadow lies still on the ground: its layer has motion channels, like any. A shadow that
    moves itself changes its shape without surfaces that could be followed: `samples` shadows are averaged.
    """

    def rendering(scene: Scene, camera: Camera) -> Layer:
        return shadow_layer(renderer, scene, camera, catcher.mesh, catcher.strength)

    shutter, middle_s = filmed.shutter, filmed.shutter.middle_s(time_s)
    span_s = shutter.exposure_s + abs(shutter.readout_s)
    if span_s > 0.0 and not filmed.is_scene_still((middle_s - 0.5 * span_s, middle_s, middle_s + 0.5 * span_s)):
        return accumulated(rendering, filmed, time_s, samples)
    # On the ground, whatever is seen keeps its place: nothing has to be followed but the camera.
    scene = filmed.scene_at(middle_s)
    return followed(rendering, replace(filmed, scene_at=lambda _: scene), time_s, MotionQuality(most_samples=samples))


def accumulated(rendering: Rendering, filmed: FilmedScene, time_s: float, samples: int, band_px: int = 8) -> Layer:
    """The mean of `samples` pictures over the shutter, premultiplied; depth is the one that is seen nearest to the middle of it.

    rendering: such as `renderer.render`. band_px: with a rolling shutter, so many rows are exposed at one time, that of their
    middle. Blurred already, the layer has no motion channels. It cannot tell light of different depths in one pixel apart.
    """
    if samples < 1 or band_px < 1:
        raise InputError(f"an accumulation needs at least one picture and bands of one row, got {samples} and {band_px}")
    height_px = filmed.camera_at(filmed.shutter.middle_s(time_s)).height_px
    step = band_px if filmed.shutter.is_rolling else height_px
    bands = [_band(rendering, filmed, time_s, samples, (top, min(top + step, height_px))) for top in range(0, height_px, step)]
    names = bands[0].extra
    return Layer(
        np.concatenate([band.rgb for band in bands]),
        np.concatenate([band.alpha for band in bands]),
        np.concatenate([band.depth_m for band in bands]),
        {name: np.concatenate([band.extra[name] for band in bands]) for name in names},
    )


def _band(rendering: Rendering, filmed: FilmedScene, time_s: float, samples: int, rows: tuple[int, int]) -> Layer:
    shutter = filmed.shutter
    height_px = filmed.camera_at(time_s).height_px
    middle_s = time_s + shutter.row_delay_s(0.5 * (rows[0] + rows[1]), height_px)
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    order = np.argsort(np.abs(offsets), kind="stable")
    total: Layer | None = None
    for offset in offsets[order].tolist():
        moment_s = middle_s + offset * shutter.exposure_s
        camera = filmed.camera_at(moment_s)
        shown = rendering(filmed.scene_at(moment_s), Box(*rows, 0, camera.width_px).camera_of(camera))
        total = shown if total is None else _sum(total, shown)
    assert total is not None
    share = np.float32(1.0 / samples)
    alpha = np.minimum(total.alpha * share, np.float32(1.0))
    return Layer(total.rgb * share, alpha, total.depth_m, {name: values * share for name, values in total.extra.items()})


def _sum(one: Layer, other: Layer) -> Layer:
    return Layer(
        one.rgb + other.rgb,
        one.alpha + other.alpha,
        np.where(np.isfinite(one.depth_m), one.depth_m, other.depth_m),
        {name: values + other.extra[name] for name, values in one.extra.items()},
    )


def rolled(layer: Layer, paths: Paths, span_s: float, shutter: ShutterTiming) -> Layer:
    """The layer of the middle row's moment, moved row by row along its paths to where each row sees it.

    paths: over `span_s`, of what the layer shows. Motion channels become what the rows see of them: what runs with the readout
    is drawn longer. Things that move differently side by side are told apart only where they are in the middle.
    """
    box = paths.box.grown(int(np.ceil(paths.length_px)) + 1).within(layer.alpha.shape)
    x, y = np.meshgrid(np.arange(box.left - 1, box.right + 1) + 0.5, np.arange(box.top - 1, box.bottom + 1) + 0.5)
    delay_s = np.array([shutter.row_delay_s(row, layer.height_px) for row in y[:, 0].tolist()]) - 0.5 * shutter.readout_s
    positions_px = _sources_px(np.stack([x, y], axis=-1), paths, delay_s / span_s)
    return box.placed(resampled(layer, positions_px, paths.box), layer.alpha.shape)


def _sources_px(
    xy_px: Float64[np.ndarray, "rows columns 2"], paths: Paths, delays: Float64[np.ndarray, " rows"]
) -> Float64[np.ndarray, "rows columns 2"]:
    """The places p with p + motion(p) delay = xy, by repeated substitution."""
    found = xy_px
    for _ in range(_STEPS):
        at = (found - (paths.box.left + 0.5, paths.box.top + 0.5)).astype(np.float32)
        motion_px = cv2.remap(paths.motion_px, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        last, found = found, xy_px - motion_px.astype(np.float64) * delays[:, None, None]
        if np.abs(found - last).max() < _CLOSE_PX:
            break
    return found
