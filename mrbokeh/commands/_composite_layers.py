"""Layers of `mrbokeh composite` by its options: of files, of objects in their light, and of a scene."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mrbokeh.commands._composite_options import (
    NOTHING,
    CompositeOptions,
    ObjectOptions,
    RenderingOptions,
    typed_height,
    typed_pixel,
    typed_place_m,
    typed_sun,
)
from mrbokeh.commands._level_ground import HIGH_SHARE, held_as_told, usual_tilt_rad
from mrbokeh.compositing.ground import ended_shadow, ground_under
from mrbokeh.compositing.plate import Plate
from mrbokeh.images.layer import Layer, flatten
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.staging.scene_description import SceneDescription, looking_down
from mrbokeh.stacks.capture_bundle import CaptureBundle
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import guess, warn

if TYPE_CHECKING:
    from mrbokeh.commands._composite_kept import KeptParts
    from mrbokeh.scene.staging.filming import Filming
    from mrbokeh.scene.staging.scene_description import Lighting, OneObject
    from mrbokeh.solving.sun_of_photograph import SunOfPhotograph
    from mrbokeh.stacks.exr_layers.deep_layers import DeepSamples

_COVERED = 0.5
_HIGHEST = 20.0
_SAME_LEVEL, _ROUNDING = 0.05, 1e-6
"""Share by which depths of one level of ground may differ."""
_DARK = 0.6
"""How dark the shadow of a light is, where nothing tells."""

LayersFor = Callable[[Plate], list[Layer]]
"""The same scene for every plate of one view: sharp layers, front first."""


def layers_by(options: CompositeOptions, first: Plate, bundle: CaptureBundle | None = None, kept: "KeptParts | None" = None) -> LayersFor:
    """Return the layers of the options. first: the plate on whose pixels the objects stand. kept: from earlier pictures of the photograph.

    Raises InputError if there is nothing to insert.
    """
    virtual, standing, rendering = options.virtual, options.standing, options.rendering
    files = _FileLayers.of(virtual.layer or (), virtual.object_names)
    still = [*files.flat, *(bundle.layers if bundle else ())]
    rendered = []
    if standing.object_:
        rendered.append(_object_layers(standing, rendering, first, kept))
    if virtual.scene is not None:
        rendered.append(_scene_layers(virtual.scene, virtual.camera, rendering))
    if not still and not rendered and not files.deep:
        raise InputError(NOTHING)
    if standing.at_pixel and not rendered:
        standing_there = standing_on_pixel(files.among(still), first, *standing.first_px)
        return lambda _: standing_there
    if standing.at_pixel and not standing.object_:
        raise InputError("--at-pixel places an --object or the --layers; a scene file says itself where its objects stand: leave it out")
    return lambda plate: files.among([*still, *(layer for make in rendered for layer in make(plate))])


def standing_on_pixel(layers: Sequence[Layer], plate: Plate, x_px: float, y_px: float) -> list[Layer]:
    """Scale the depth of all layers about the camera, which leaves their picture as it is, so that they stand on a pixel.

    The part of them that is at the pixel, or nearest to it, then lies as far as the photograph there. Raises InputError if none of them
    has a depth.
    """
    surface_m = _under_pixel_m(plate, x_px, y_px)[2]
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
        for path, sequence in zip(paths, sequences, strict=True):
            if len(sequence.paths) > 1:
                one = next(iter(sequence.paths.values()))
                raise InputError(
                    f"--layer {path} is {len(sequence.paths)} pictures: name one, such as {one}, or put all into a clip with `video`"
                )
        flat = [layer for each in sequences if not each.is_deep for layer in each.layers(each.frames[0])]
        return cls(flat, [each.samples(each.frames[0]) for each in sequences if each.is_deep])

    def among(self, layers: list[Layer]) -> list[Layer]:
        """Return the deep layers among others, front first."""
        if not self.deep:
            return layers
        from mrbokeh.stacks.exr_layers.deep_layers import interleaved

        return interleaved(self.deep, layers)


def _object_layers(options: ObjectOptions, rendering: RenderingOptions, first: Plate, kept: "KeptParts | None") -> LayersFor:
    """Return the objects in one layer, and behind it what the ground under them catches: a layer for each level of ground."""
    catches = rendering.catch or ("shadow" if options.plain else "light")
    usual = 0.0 if options.plain else _DARK if catches == "shadow" else 1.0
    shadow = usual if options.shadow is None else options.shadow
    contrast = 1.0 if options.plain else first.shadow_contrast
    filming = replace(rendering.of_photograph.filming(), catches=catches, caught_share=shadow, caught_contrast=contrast)
    placed = objects_of(options, first, shadow)
    light = light_of(options, first, options.first_px if options.at_pixel else _pixel_of(first.camera, placed[0].stands_at_m), kept)
    placed = [replace(each, light=light) for each in placed]
    grounds = _grounds(placed)

    def filmed(*objects: "OneObject") -> LayersFor:
        head, *beside = objects
        return _filmed(head.described(*beside), filming, rendering.time, lambda plate: head.seen_by(plate.camera), kept)

    on_grounds = [filmed(*(placed[number] for number in ground)) for ground in grounds]
    together = filmed(*(replace(each, shadow=0.0) for each in placed)) if len(grounds) > 1 else None
    feet_px = [[options.pixels[number] for number in ground] if options.at_pixel else [] for ground in grounds]

    def layers(plate: Plate) -> list[Layer]:
        parts = [make(plate) for make in on_grounds]
        objects = parts[0][0] if together is None else together(plate)[0]
        caught = [(feet, layer) for feet, (_objects, *some) in zip(feet_px, parts, strict=True) for layer in some]
        return [objects, *(ended_shadow(plate, feet, objects, layer) if feet else layer for feet, layer in caught)]

    return layers


def objects_of(options: ObjectOptions, plate: Plate, shadow: float = 0.0) -> "list[OneObject]":
    """Return the objects at their places, not lit yet.

    Depth of one table is not exact: objects on pixels whose levels differ by less than a share stand on that of the first of them, where
    the same line of sight meets it.
    """
    from mrbokeh.scene.staging.scene_description import OneObject

    placed: list[OneObject] = []
    for each in options.each:
        stands_at_m = typed_place_m(each.at) if each.at else _under_pixel_m(plate, *typed_pixel(each.at_pixel or ""))
        one = OneObject(
            glb=each.glb,
            stands_at_m=stands_at_m,
            turn_rad=math.radians(each.turn),
            world_from_camera=np.eye(3) if plate.world_from_camera is None else plate.world_from_camera,
            shadow=shadow,
        )
        levels = [other.foot_m[1] / one.foot_m[1] for other in placed] if one.foot_m[1] and options.at_pixel else []
        nearer = next((level for level in levels if abs(level - 1.0) < _SAME_LEVEL), 1.0)
        x_m, y_m, z_m = stands_at_m
        moved_m = stands_at_m if nearer == 1.0 else (nearer * x_m, nearer * y_m, nearer * z_m)
        placed.append(replace(one, stands_at_m=moved_m, height_m=_height_m(each.height, plate, moved_m[2])))
    return placed


def _under_pixel_m(plate: Plate, x_px: float, y_px: float) -> tuple[float, float, float]:
    """Return the place that a pixel shows, and say where its depth is that of its surroundings."""
    place_m = plate.point_under_pixel_m(x_px, y_px)
    if plate.is_depth_from_around(x_px, y_px):
        guess(f"nothing near --at-pixel told its depth, so that {place_m[2]:.3g} m is that of its surroundings: choose a pixel with detail")
    return place_m


def _grounds(objects: "Sequence[OneObject]") -> list[list[int]]:
    """Return the numbers of the objects by the level of ground on which they stand."""
    levels_m, grounds = [each.foot_m[1] for each in objects], list[list[int]]()
    for number, level_m in enumerate(levels_m):
        same = (ground for ground in grounds if math.isclose(levels_m[ground[0]], level_m, rel_tol=_ROUNDING, abs_tol=_ROUNDING))
        if (ground := next(same, None)) is None:
            grounds.append([number])
        else:
            ground.append(number)
    return grounds


def objects_apart(options: CompositeOptions, plate: Plate, sharp: Sequence[Layer], kept: "KeptParts | None" = None) -> list[Layer]:
    """Return each object alone, as if no other hid it. sharp: layers of all together."""
    if len(options.standing.each) == 1:
        return [sharp[0]]
    filming, time_s = options.rendering.of_photograph.filming(), options.rendering.time
    return [
        _filmed(one.described(), filming, time_s, lambda seen, one=one: one.seen_by(seen.camera), kept)(plate)[0]  # type: ignore[misc]
        for one in objects_of(options.standing, plate)
    ]


def _pixel_of(camera: Camera, place_m: tuple[float, float, float]) -> tuple[float, float]:
    """Return the pixel that shows a place, or the nearest of the frame."""
    xy_px, _ = camera.project(np.array(place_m)[None])
    x_px, y_px = np.clip(xy_px[0], 0, [camera.width_px - 1, camera.height_px - 1]).tolist()
    return x_px, y_px


def held_upright(plate: Plate, options: ObjectOptions) -> Plate:
    """Return the plate with the turn of its camera: as told, as known already, by the ground at the foot of an object, or none."""
    if options.pitch is not None or plate.world_from_camera is not None or options.plain or not options.at_pixel:
        return held_as_told(plate, options)
    foot_px = options.first_px
    plate.require_pixel(*foot_px)
    found = ground_under(plate, foot_px) if plate.slopes_known else None
    if found is None:
        down_rad = usual_tilt_rad(plate, plate.camera.unproject(np.array(foot_px), np.array(1.0)))
        why = "the depth around the foot is no ground with a slope" if plate.slopes_known else "guessed metres tell no slope of the ground"
        guess(f"{why}: the camera is taken to look down by {math.degrees(down_rad):.0f} degrees, as is usual (--pitch DEGREES)")
        return held_as_told(replace(plate, world_from_camera=looking_down(down_rad)), options)
    down_deg = math.degrees(math.asin(float(np.clip(found[1, 2], -1.0, 1.0))))
    guess(f"by the depth around the foot the camera looks down by {down_deg:.0f} degrees (else --pitch DEGREES)")
    return held_as_told(replace(plate, world_from_camera=found), options)


def light_of(options: ObjectOptions, plate: Plate, foot_px: tuple[float, float], kept: "KeptParts | None") -> "Lighting":
    """Return the light of objects: its panorama, even light, or what the photograph tells of it."""
    from mrbokeh.compositing.plate_light import is_sunlit, picture_light
    from mrbokeh.scene.staging.scene_description import Lighting

    if options.environment or options.plain:
        return Lighting(options.environment, exposure=options.exposure)
    lit = picture_light if kept is None else kept.light
    world_from_camera = np.eye(3) if plate.world_from_camera is None else plate.world_from_camera
    if options.sun is not None:
        sun_degrees: tuple[float, float] | None = typed_sun(options.sun)
        guess("--sun is as strong beside the sky as on a clear day; how bright both are is guessed from the photograph (--exposure)")
    else:
        sun_degrees = _sun_by_file(plate.sun, shines=is_sunlit(plate, foot_px))
    made = lit(plate, foot_px, world_from_camera, sun_degrees)
    return Lighting(exposure=options.exposure, made=made)


def _sun_by_file(sun: "SunOfPhotograph | None", *, shines: bool) -> tuple[float, float] | None:
    """Return degrees to the right of the view and above the horizon as the file tells them, if the sun shines, and say what is taken."""
    degrees = None if sun is None or sun.right_deg is None or not sun.is_up else (round(sun.right_deg), round(sun.above_deg))
    option = "--sun RIGHT,ABOVE" if degrees is None else f"--sun {degrees[0]},{degrees[1]}"
    if not shines:
        there = "" if degrees is None else ", where the sun would be by the file"
        guess(f"the object's light is guessed from the photograph (else --exposure, {option}{there}, --environment or --plain)")
        return None
    if sun is None:
        guess("by the exposure the sun shines: a soft light from behind at the left is taken (--sun RIGHT,ABOVE says where it is)")
    elif degrees is None:
        guess(
            f"by the exposure the sun shines, and by time and place in the file it stood {sun.above_deg:.0f} degrees high; no compass "
            f"tells on which side: a soft light from behind at the left is taken (--sun RIGHT,{sun.above_deg:.0f}, or --sun-by, says more)"
        )
    else:
        north = ", turned from magnetic to true north," if sun.from_magnetic_north else ""
        guess(
            f"by the exposure the sun shines, and by time, place and compass{north} in the file it stood at {option}, which is taken; a "
            f"compass may be wrong by 20 degrees and more (--sun RIGHT,ABOVE, --sun-by TOP:FOOT:TIP)"
        )
    return degrees


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
