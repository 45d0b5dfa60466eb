"""Layers of `mrbokeh composite` by its options: of files, of one object and its light, and of a scene."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mrbokeh.commands._composite_options import CompositeOptions, ObjectOptions, RenderingOptions, typed_height, typed_place_m, typed_sun
from mrbokeh.commands._level_ground import HIGH_SHARE, pair_of
from mrbokeh.compositing.ground import ended_shadow, ground_under
from mrbokeh.compositing.plate import Plate
from mrbokeh.images.layer import Layer, flatten
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.staging.scene_description import SceneDescription, looking_down
from mrbokeh.stacks.capture_bundle import CaptureBundle
from mrbokeh.system.channel import guess, warn
from mrbokeh.system.errors import InputError

if TYPE_CHECKING:
    from mrbokeh.commands._composite_kept import KeptParts
    from mrbokeh.scene.staging.filming import Filming
    from mrbokeh.scene.staging.scene_description import Lighting
    from mrbokeh.stacks.exr_layers.deep_layers import DeepSamples

_COVERED = 0.5
_HIGHEST = 20.0
_DARK = 0.6
"""How dark the shadow of a light is, where nothing tells."""

LayersFor = Callable[[Plate], list[Layer]]
"""The same scene for every plate of one view: sharp layers, front first."""


def layers_by(options: CompositeOptions, first: Plate, bundle: CaptureBundle | None = None, kept: "KeptParts | None" = None) -> LayersFor:
    """Return the layers of the options. first: the plate on whose pixel the object stands. kept: from earlier pictures of the photograph.

    Raises InputError if there is nothing to insert.
    """
    virtual, standing, rendering = options.virtual, options.standing, options.rendering
    files = _FileLayers.of(virtual.layer or (), virtual.object_names)
    still = [*files.flat, *(bundle.layers if bundle else ())]
    rendered = []
    if standing.object_ is not None:
        rendered.append(_object_layers(standing.object_, standing, rendering, first, kept))
    if virtual.scene is not None:
        rendered.append(_scene_layers(virtual.scene, virtual.camera, rendering))
    if not still and not rendered and not files.deep:
        raise InputError("nothing to put into the photograph: give --object OBJ.glb, --scene SCENE.toml or --layer RGBAZ.exr")
    if standing.at_pixel and not rendered:
        x_px, y_px = pair_of(standing.at_pixel)
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
        from mrbokeh.stacks.exr_layers.deep_layers import interleaved

        return interleaved(self.deep, layers)


def _object_layers(
    glb: Path, options: ObjectOptions, rendering: RenderingOptions, first: Plate, kept: "KeptParts | None" = None
) -> LayersFor:
    from mrbokeh.scene.staging.scene_description import OneObject

    stands_at_m = typed_place_m(options.at) if options.at else first.point_under_pixel_m(*pair_of(options.at_pixel))
    foot_px = pair_of(options.at_pixel) if options.at_pixel else _pixel_of(first.camera, stands_at_m)
    world_from_camera = np.eye(3) if first.world_from_camera is None else first.world_from_camera
    catches = rendering.catch or ("shadow" if options.plain else "light")
    usual = 0.0 if options.plain else _DARK if catches == "shadow" else 1.0
    shadow = usual if options.shadow is None else options.shadow
    one = OneObject(
        glb=glb,
        stands_at_m=stands_at_m,
        height_m=_height_m(options.height, first, stands_at_m[2]),
        turn_rad=math.radians(options.turn),
        world_from_camera=world_from_camera,
        light=_light(options, first, foot_px, world_from_camera, kept),
        shadow=shadow,
    )
    filming = replace(rendering.of_photograph.filming(), catches=catches, caught_share=shadow)
    filmed = _filmed(one.described(), filming, rendering.time, lambda plate: one.seen_by(plate.camera), kept)
    if not options.at_pixel:
        return filmed

    def on_the_ground(plate: Plate) -> list[Layer]:
        objects, *caught = filmed(plate)
        return [objects, *(ended_shadow(plate, foot_px, objects, each) for each in caught)]

    return on_the_ground


def _pixel_of(camera: Camera, place_m: tuple[float, float, float]) -> tuple[float, float]:
    """Return the pixel that shows a place, or the nearest of the frame."""
    xy_px, _ = camera.project(np.array(place_m)[None])
    x_px, y_px = np.clip(xy_px[0], 0, [camera.width_px - 1, camera.height_px - 1]).tolist()
    return x_px, y_px


def held_upright(plate: Plate, options: ObjectOptions) -> Plate:
    """Return the plate with the turn of its camera: as told, as known already, by the ground at the foot of an object, or none."""
    if options.pitch is not None:
        return replace(plate, world_from_camera=looking_down(math.radians(options.pitch)))
    if plate.world_from_camera is not None or options.plain or not options.at_pixel:
        return plate
    foot_px = pair_of(options.at_pixel)
    plate.require_pixel(*foot_px)
    found = ground_under(plate, foot_px)
    if found is None:
        guess("the depth around the foot is no ground with a slope: a level camera is taken (--pitch DEGREES says how far it looks down)")
        return plate
    down_deg = math.degrees(math.asin(float(np.clip(found[1, 2], -1.0, 1.0))))
    guess(f"by the depth around the foot the camera looks down by {down_deg:.0f} degrees (else --pitch DEGREES)")
    return replace(plate, world_from_camera=found)


def _light(
    options: ObjectOptions, plate: Plate, foot_px: tuple[float, float], world_from_camera: np.ndarray, kept: "KeptParts | None"
) -> "Lighting":
    """Return the light of an object: its panorama, even light, or what the photograph tells of it."""
    from mrbokeh.compositing.plate_light import is_sunlit, picture_light
    from mrbokeh.scene.staging.scene_description import Lighting

    if options.environment or options.plain:
        return Lighting(options.environment, exposure=options.exposure)
    lit = picture_light if kept is None else kept.light
    made = lit(plate, foot_px, world_from_camera, None if options.sun is None else typed_sun(options.sun))
    if options.sun is None and is_sunlit(plate, foot_px):
        guess("by the exposure the sun shines: a soft light from behind the camera is taken (--sun RIGHT,ABOVE says where it is)")
    elif options.sun is None:
        guess("the object's light is guessed from the photograph (else --exposure, --sun RIGHT,ABOVE, --environment or --plain)")
    else:
        guess("--sun is as strong beside the sky as on a clear day; how bright both are is guessed from the photograph (--exposure)")
    return Lighting(exposure=options.exposure, made=made)


def _height_m(text: str | None, plate: Plate, depth_m: float) -> float | None:
    """Return metres as told, or of so many pixels at that depth; None keeps the size of the file, unless metres are guessed."""
    if text is None:
        return plate.length_m(HIGH_SHARE * plate.rgb.shape[0], depth_m) if plate.metres_guessed else None
    number, in_pixels = typed_height(text)
    if plate.metres_guessed and not in_pixels:
        warn(f"--height {text} counts metres, but those of the photograph's depth are guessed: such as --height 120px says better")
    height_px = number if in_pixels else number / plate.length_m(1.0, depth_m)
    if height_px > _HIGHEST * plate.rgb.shape[0]:
        raise InputError(
            f"--height {text} is {height_px / plate.rgb.shape[0]:.0f} times as high as the picture at {depth_m:.3g} m: expected metres, or "
            f"pixels such as 120px"
        )
    return plate.length_m(height_px, depth_m)


def _scene_layers(path: Path, camera: Path | None, rendering: RenderingOptions) -> LayersFor:
    """Return the layers of a scene file; without a camera file the world of the scene is the plate's camera."""
    from mrbokeh.scene.staging.scene_file import read_scene_file
    from mrbokeh.shots.frame_sources import scene_track

    description = read_scene_file(path)

    def seen_by(plate: Plate) -> Camera:
        size_px = (plate.rgb.shape[1], plate.rgb.shape[0])
        return plate.camera if camera is None else scene_track(camera, size_px, description.up).at(0).camera.resized(*size_px)

    return _filmed(description, rendering.of_photograph.filming(), rendering.time, seen_by)


def _filmed(
    description: SceneDescription,
    filming: "Filming",
    time_s: float,
    seen_by: Callable[[Plate], Camera],
    kept: "KeptParts | None" = None,
) -> LayersFor:
    from mrbokeh.scene.staging.filming import FilmedLayers

    if kept is None:
        filmed = FilmedLayers(filming, description)
    else:
        filmed = FilmedLayers(kept.filming(filming), description, assets=kept.assets, renderer=kept.renderer(filming))

    def layers(plate: Plate) -> list[Layer]:
        sharp_rgb = plate.rgb if plate.sharp_rgb is None else plate.sharp_rgb
        return filmed.at(lambda _: seen_by(plate), time_s, sharp_rgb)

    return layers
