"""What `mrbokeh composite` puts in: layers of other renderers, an object, a scene; as options say."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from mrbokeh.camera import Camera
from mrbokeh.capture_bundle import CaptureBundle
from mrbokeh.errors import InputError
from mrbokeh.layer import Layer
from mrbokeh.plate import Plate
from mrbokeh.staging.scene_description import SceneDescription

LayersFor = Callable[[Plate], list[Layer]]
"""The same scene for every plate of one view: sharp layers, front first."""


@dataclass(frozen=True)
class ObjectOptions:
    """Where the --object stands: at or at_pixel, as typed; angles in degrees."""

    glb: Path | None
    at: str | None
    at_pixel: str | None
    height_m: float | None
    turn_deg: float
    tilt_deg: float
    environment: Path | None
    exposure: float
    shadow: float


@dataclass(frozen=True)
class SceneOptions:
    """A scene file with its camera, and how objects and scenes are rendered; time_s: of their animations."""

    path: Path | None
    camera: Path | None
    time_s: float
    backend: str
    samples: int
    catches: str
    distortion: Path | None


@dataclass(frozen=True)
class VirtualOptions:
    """files: of layers; cryptomatte: names of the objects that are taken of them, as typed."""

    files: tuple[Path, ...]
    cryptomatte: str | None
    standing: ObjectOptions
    rendering: SceneOptions


def layers_by(options: VirtualOptions, first: Plate, bundle: CaptureBundle | None) -> LayersFor:
    """first: the plate on whose pixel the object stands. Raises InputError where there is nothing to put in."""
    still = [*_file_layers(options.files, options.cryptomatte), *(bundle.layers if bundle else ())]
    rendered = []
    if options.standing.glb is not None:
        rendered.append(_object_layers(options.standing.glb, options.standing, options.rendering, first))
    if options.rendering.path is not None:
        rendered.append(_scene_layers(options.rendering.path, options.rendering))
    if not still and not rendered:
        raise InputError("nothing to put into the photograph: give --object OBJ.glb, --scene SCENE.toml or --layer RGBAZ.exr")
    return lambda plate: [*still, *(layer for make in rendered for layer in make(plate))]


def _file_layers(paths: Sequence[Path], cryptomatte: str | None) -> list[Layer]:
    """Layers of EXR files, front first."""
    from mrbokeh.exr_layers.object_split import ObjectSplit
    from mrbokeh.exr_layers.sequence import ExrSequence

    reader = None if cryptomatte is None else ObjectSplit(objects=tuple(cryptomatte.split(",")), with_rest=False)
    sequences = [ExrSequence.of(path, reader) for path in paths]
    return [layer for sequence in sequences for layer in sequence.layers(sequence.frames[0])]


def _object_layers(glb: Path, options: ObjectOptions, rendering: SceneOptions, first: Plate) -> LayersFor:
    from mrbokeh.staging.one_object import OneObject
    from mrbokeh.staging.scene_description import Lighting

    stands_at_m = _triple(options.at) if options.at else first.point_under_pixel_m(*_pair(options.at_pixel))
    light = Lighting(options.environment, exposure=options.exposure)
    turn, tilt = math.radians(options.turn_deg), math.radians(options.tilt_deg)
    one = OneObject(glb, stands_at_m, options.height_m, turn, tilt, light, options.shadow)
    return _filmed(one.described(), rendering, lambda plate: one.seen_by(plate.camera))


def _scene_layers(path: Path, options: SceneOptions) -> LayersFor:
    """Without a camera file the world of the scene is the plate's camera."""
    from mrbokeh.camera_track.formats import read_track
    from mrbokeh.camera_track.options import TrackOptions
    from mrbokeh.staging.scene_file import read_scene_file

    def seen_by(plate: Plate) -> Camera:
        size_px = (plate.rgb.shape[1], plate.rgb.shape[0])
        if options.camera is None:
            return plate.camera
        return read_track(options.camera, TrackOptions(size_px=size_px)).at(0).camera.resized(*size_px)

    return _filmed(read_scene_file(path), options, seen_by)


def _filmed(description: SceneDescription, options: SceneOptions, seen_by: Callable[[Plate], Camera]) -> LayersFor:
    from mrbokeh.lens_distortion.distortion_json import read_distortion
    from mrbokeh.staging.filming import FilmedLayers, Filming

    filming = Filming(options.backend, options.samples, catches=options.catches, distortion=read_distortion(options.distortion))
    filmed = FilmedLayers(filming, description)

    def layers(plate: Plate) -> list[Layer]:
        sharp_rgb = plate.rgb if plate.sharp_rgb is None else plate.sharp_rgb
        return filmed.at(lambda _: seen_by(plate), options.time_s, sharp_rgb)

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
