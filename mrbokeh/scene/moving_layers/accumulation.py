"""The plain slow way: pictures at many moments of the shutter, averaged; every band of rows at its own times."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Scene
from mrbokeh.scene.moving_layers.filmed_scene import FilmedScene
from mrbokeh.system.errors import InputError

Rendering = Callable[[Scene, Camera], Layer]


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
    middle_s = shutter.first_row_middle_s(time_s) + shutter.row_delay_s(0.5 * (rows[0] + rows[1]), height_px)
    offsets = (np.arange(samples) + 0.5) / samples - 0.5
    order = np.argsort(np.abs(offsets), kind="stable")
    total: Layer | None = None
    for offset in offsets[order].tolist():
        moment_s = middle_s + offset * shutter.exposure_s
        shown = rendering(filmed.scene_at(moment_s), _rows_of(filmed.camera_at(moment_s), rows))
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


def _rows_of(camera: Camera, rows: tuple[int, int]) -> Camera:
    """The camera that sees only these rows."""
    principal = (camera.principal_px[0], camera.principal_px[1] - rows[0])
    return replace(camera, height_px=rows[1] - rows[0], principal_px=principal)
