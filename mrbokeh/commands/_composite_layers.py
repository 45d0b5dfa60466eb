"""Layers that `mrbokeh composite` inserts, by its options: layers of other renderers, an object, a scene."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mrbokeh.commands._composite_options import ObjectOptions, RenderingOptions
from mrbokeh.commands._insertion_options import VirtualOptions
from mrbokeh.compositing.plate import Plate
from mrbokeh.images.layer import Layer, flatten
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.staging.scene_description import SceneDescription
from mrbokeh.stacks.capture_bundle import CaptureBundle
from mrbokeh.system.errors import InputError

if TYPE_CHECKING:
    from mrbokeh.stacks.exr_layers.deep_layers import DeepSamples

_COVERED = 0.5
_HIGH_SHARE = 0.25
"""Share of the picture's height that an object takes whose size is neither told nor known."""

LayersFor = Callable[[Plate], list[Layer]]
"""The same scene for every plate of one view: sharp layers, front first."""


def layers_by(
    virtual: VirtualOptions, standing: ObjectOptions, rendering: RenderingOptions, first: Plate, bundle: CaptureBundle | None
) -> LayersFor:
    """Return the layers of the options. first: the plate on whose pixel the object stands. Raises InputError if there is nothing to
    insert.
    """
    files = _FileLayers.of(virtual.layer or (), virtual.object_names)
    still = [*files.flat, *(bundle.layers if bundle else ())]
    rendered = []
    if standing.object_ is not None:
        rendered.append(_object_layers(standing.object_, standing, rendering, first))
    if virtual.scene is not None:
        rendered.append(_scene_layers(virtual.scene, virtual.camera, rendering))
    if not still and not rendered and not files.deep:
        raise InputError("nothing to put into the photograph: give --object OBJ.glb, --scene SCENE.toml or --layer RGBAZ.exr")
    if standing.at_pixel and not rendered:
        x_px, y_px = _pair(standing.at_pixel)
        standing_there = standing_on_pixel(files.among(still), first, x_px, y_px)
        return lambda _: standing_there
    if standing.at_pixel and standing.object_ is None:
        raise InputError("--at-pixel places an --object or the --layers; a scene file says itself where its objects stand: leave it out")
    return lambda plate: files.among([*still, *(layer for make in rendered for layer in make(plate))])


def standing_on_pixel(layers: Sequence[Layer], plate: Plate, x_px: float, y_px: float) -> list[Layer]:
    """Scale the depth of all layers about the camera, which leaves their picture as it is, so that they stand on a pixel.

    The part of them that is at the pixel, or nearest to it, then lies as far as the photograph there. Raises InputError if none of them
    has a depth.
    """
    surface_m = plate.point_under_pixel_m(x_px, y_px)[2]
    whole = flatten(layers)
    rows, columns = np.nonzero((whole.alpha > _COVERED) & np.isfinite(whole.depth_m) & (whole.depth_m > 0))
    if not len(rows):
        raise InputError("--at-pixel: expected a layer with depth (Z) where it covers the picture, found none: render it with its Z")
    nearest = int(np.argmin(np.hypot(rows - int(y_px), columns - int(x_px))))
    factor = np.float32(surface_m / whole.depth_m[rows[nearest], columns[nearest]])
    return [replace(layer, depth_m=layer.depth_m * factor) for layer in layers]


@dataclass(frozen=True)
class _FileLayers:
    """Layers of EXR files. flat: front first; deep: which find their places by depth."""

    flat: Sequence[Layer]
    deep: "Sequence[DeepSamples]"

    @classmethod
    def of(cls, paths: Sequence[Path], object_names: tuple[str, ...]) -> "_FileLayers":
        from mrbokeh.shots.layer_sources import layer_sequence

        sequences = [layer_sequence(path, object_names) for path in paths]
        flat = [layer for each in sequences if not each.is_deep for layer in each.layers(each.frames[0])]
        return cls(flat, [each.samples(each.frames[0]) for each in sequences if each.is_deep])

    def among(self, layers: list[Layer]) -> list[Layer]:
        """Return the deep layers among others, front first."""
        if not self.deep:
            return layers
        from mrbokeh.stacks.exr_layers.deep_interleaved import interleaved

        return interleaved(self.deep, layers)


def _object_layers(glb: Path, options: ObjectOptions, rendering: RenderingOptions, first: Plate) -> LayersFor:
    from mrbokeh.scene.staging.scene_description import Lighting, OneObject

    if options.at and options.at_pixel:
        raise InputError("--at and --at-pixel both say where the object stands: give one of them")
    stands_at_m = _triple(options.at) if options.at else first.point_under_pixel_m(*_pair(options.at_pixel))
    light = Lighting(options.environment, exposure=options.exposure)
    turn, tilt = math.radians(options.turn), math.radians(options.tilt)
    one = OneObject(
        glb=glb,
        stands_at_m=stands_at_m,
        height_m=_height_m(options.height, first, stands_at_m[2]),
        turn_rad=turn,
        tilt_rad=tilt,
        light=light,
        shadow=options.shadow,
    )
    return _filmed(one.described(), rendering, lambda plate: one.seen_by(plate.camera))


def _height_m(text: str | None, plate: Plate, depth_m: float) -> float | None:
    """Return metres as told, or of so many pixels at that depth; None keeps the size of the file, unless metres are guessed."""
    if text is None:
        return plate.length_m(_HIGH_SHARE * plate.rgb.shape[0], depth_m) if plate.metres_guessed else None
    try:
        number = float(text.removesuffix("px"))
    except ValueError:
        number = math.nan
    if not 0.0 < number < math.inf:
        raise InputError(f"--height: expected metres above 0 such as 0.1, or pixels such as 120px, got {text!r}")
    return plate.length_m(number, depth_m) if text.endswith("px") else number


def _scene_layers(path: Path, camera: Path | None, rendering: RenderingOptions) -> LayersFor:
    """Return the layers of a scene file; without a camera file the world of the scene is the plate's camera."""
    from mrbokeh.scene.staging.scene_file import read_scene_file
    from mrbokeh.shots.frame_sources import scene_track

    description = read_scene_file(path)

    def seen_by(plate: Plate) -> Camera:
        size_px = (plate.rgb.shape[1], plate.rgb.shape[0])
        return plate.camera if camera is None else scene_track(camera, size_px, description.up).at(0).camera.resized(*size_px)

    return _filmed(description, rendering, seen_by)


def _filmed(description: SceneDescription, rendering: RenderingOptions, seen_by: Callable[[Plate], Camera]) -> LayersFor:
    from mrbokeh.scene.staging.filming import FilmedLayers

    filmed = FilmedLayers(rendering.filming(), description)

    def layers(plate: Plate) -> list[Layer]:
        sharp_rgb = plate.rgb if plate.sharp_rgb is None else plate.sharp_rgb
        return filmed.at(lambda _: seen_by(plate), rendering.time, sharp_rgb)

    return layers


def _triple(text: str) -> tuple[float, float, float]:
    x_m, y_m, z_m = _numbers(text, 3, "--at")
    return x_m, y_m, z_m


def _pair(at_pixel: str | None) -> tuple[float, float]:
    if at_pixel is None:
        raise InputError("where does the object stand? Give --at X,Y,Z in metres, or --at-pixel X,Y on a photograph with depth")
    x_px, y_px = _numbers(at_pixel, 2, "--at-pixel")
    return x_px, y_px


def _numbers(text: str, count: int, option: str) -> tuple[float, ...]:
    try:
        numbers = tuple(float(part) for part in text.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != count:
        raise InputError(f"{option} expects {count} numbers with commas between, got {text!r}")
    return numbers
