"""Parts of `mrbokeh composite`: plate and layers by its options, and its results, which are the picture, with .exr all layers, and files
beside it.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mrbokeh.commands._composite_options import (
    LensOptions,
    ObjectOptions,
    PlateOptions,
    RenderingOptions,
    ResultOptions,
    typed_height,
    typed_place_m,
    typed_sun,
)
from mrbokeh.commands._insertion_options import ColourOptions, LookGroup, VirtualOptions, near_far_of
from mrbokeh.commands._level_ground import HIGH_SHARE, pair_of
from mrbokeh.compositing.ground import ended_shadow, ground_under
from mrbokeh.compositing.near_and_far import nearer_than
from mrbokeh.compositing.plate import (
    Inserted,
    Plate,
    bundle_plate,
    open_plate,
    with_blur_in_metres,
    with_depth,
    with_matte,
    with_own_alpha,
)
from mrbokeh.depth.depth_map import DepthSettings, parse_near_far
from mrbokeh.depth.phone_depth import read_phone_photo
from mrbokeh.images.alpha_io import HOLDING_ALPHA, alpha_with
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.image_io import INTEGER_SUFFIXES, require_suffix
from mrbokeh.images.layer import Layer, flatten
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.scene.staging.scene_description import SceneDescription, looking_down
from mrbokeh.stacks.capture_bundle import CaptureBundle
from mrbokeh.stacks.guessed_metres import GUESSED
from mrbokeh.stacks.photograph import read_photograph
from mrbokeh.system.atomic_files import require_safe_outputs
from mrbokeh.system.channel import guess, warn
from mrbokeh.system.console import flag
from mrbokeh.system.errors import InputError
from mrbokeh.video.image_sequence import read_numbers


def plate_by(
    photo: Path,
    options: PlateOptions,
    colour: ColourOptions,
    bundle: CaptureBundle | None,
    *,
    lens: Lens | None,
    focus_m: float | None,
    facts: Mapping[str, float],
    guessing: bool = False,
) -> Plate:
    """Open the photograph, slice or bundle, with depth and matte from their files. lens, focus_m, facts: in place of its own.

    guessing: what a photograph does not tell of its lens is guessed.
    """
    if facts and photo.is_dir():
        told = " and ".join(flag(name) for name in facts)
        raise InputError(f"{told} would change the lens that {photo} states itself: leave that out, or give --lens LENS.json")
    if bundle is None:
        plate = open_plate(photo, 0 if options.all_slices else options.slice_, lens, focus_m, facts, guessing=guessing)
    else:
        plate = bundle_plate(bundle, lens, focus_m)
    if colour.of_plate is not None:
        plate = _from_space(plate, photo, colour.of_plate)
    own = photo if options.disparity and not photo.is_dir() and read_phone_photo(photo, parse_near_far(options.disparity)) else None
    near_far_m = near_far_of(options.disparity, options.depth or own)
    if options.rgb is not None:
        sharp_rgb = read_photograph(options.rgb).rgb if colour.of_plate is None else colour.of_plate.to_rec709(read_numbers(options.rgb))
        plate = replace(plate, sharp_rgb=sharp_rgb)
    source = options.depth or (photo if near_far_m or options.depth_scale else None)
    if source is not None:
        before_m, plate = plate.depth_m, with_depth(plate, source, DepthSettings(near_far_m, options.depth_scale))
        plate = replace(plate, depth_note="", metres_guessed=plate.metres_guessed and photo.is_dir())
        if own is not None and plate.blur_from and before_m is not None:
            plate = with_blur_in_metres(plate, before_m, focus_m)
    return plate if options.matte is None else with_matte(plate, options.matte)


def _from_space(plate: Plate, photo: Path, space: NamedSpace) -> Plate:
    """The photograph's own numbers, brought from their space to linear Rec.709."""
    if photo.is_dir():
        raise InputError(f"--input-space is for a photograph in a file, but {photo} is a folder that states its colours itself")
    stored = read_numbers(photo)
    if stored.shape != plate.rgb.shape:
        raise InputError(f"--input-space takes {photo} as it is stored, but it is to be turned: turn it first")
    return with_own_alpha(replace(plate, rgb=space.to_rec709(stored)), photo, plate.alpha)


def require_options_of_stacks(
    taken: PlateOptions, optics: LensOptions, look: LookGroup, colour: ColourOptions, result: ResultOptions
) -> None:
    """Raise InputError if an option is given that is of one picture, and that --all-slices would not follow."""
    one_picture = (
        (taken, ("slice_", "depth", "rgb", "disparity", "depth_scale", "matte", "near_distance")),
        (optics, ("focus", "focus_at")),
        (look, tuple(vars(look))),
        (colour, ("input_space", "output_space")),
        (result, ("save_layer", "save_deep")),
    )
    given = [name for group, names in one_picture for name in names if getattr(group, name) != getattr(type(group)(), name)]
    if given:
        told = ", ".join(f"--{name.rstrip('_').replace('_', '-')}" for name in given)
        raise InputError(
            f"--all-slices writes every slice with the stack's own depth, focus and colours, but got {told}, of one picture: "
            f"leave that out, or leave --all-slices out and choose a --slice"
        )


def check_outputs(out: Path, result: ResultOptions, read: Sequence[Path | None], *, all_slices: bool) -> None:
    """Raise InputError if a file would be lost, or cannot be what is asked for. read: the files that the command reads."""
    for path, name in ((result.save_layer, "--save-layer"), (result.save_deep, "--save-deep")):
        if path is not None:
            require_suffix(path, (".exr",), name)
    if all_slices and out.suffix:
        raise InputError(f"--all-slices writes a focal stack: expected the name of a folder, got --out {out}")
    if not all_slices:
        require_suffix(out, (".exr", *INTEGER_SUFFIXES), "--out")
    require_safe_outputs((out, result.save_layer, result.save_deep), read, result.overwrite)


def blur_told(plate: Plate, sharp: Sequence[Layer]) -> tuple[str, dict[str, Any], dict[str, Any]]:
    """Describe the lens and its blur, with what is known of the lens, and figures; if metres are guessed, give the measured pixels."""
    lens, width_px = plate.lens, plate.rgb.shape[1]
    unit = GUESSED if plate.metres_guessed else "m"
    told = f"{plate.blur_from}," if plate.blur_from else f"{lens.focal_length_mm:.4g} mm f/{lens.f_number:.3g}"
    told += f" focused at {f'{lens.focus_distance_m:.3g} {GUESSED}' if plate.metres_guessed else lens.focus_described}"
    seen_m = np.full(plate.rgb.shape[:2], np.inf, np.float32)
    for layer in reversed(sharp):
        seen_m[layer.alpha > 0.5] = layer.depth_m[layer.alpha > 0.5]
    seen_m = seen_m[np.isfinite(seen_m)]
    known = {} if plate.blur_from or plate.metres_guessed else lens.facts
    if not len(seen_m):
        return told, known, {}
    nearest_m, farthest_m = seen_m.min(), seen_m.max()
    coc_px = np.abs(lens.coc_px(np.array([nearest_m, farthest_m, np.clip(lens.focus_distance_m, nearest_m, farthest_m)]), width_px))
    size = f", {_size_px(sharp)} px" if plate.metres_guessed else ""
    far = f"{nearest_m:.3g} to {farthest_m:.3g} {unit} from the lens"
    told = f"{told}; put in at {far}{size}, blurred by {coc_px.min():.1f} to {coc_px.max():.1f} px"
    figures = {} if plate.metres_guessed else {"depths_m": (nearest_m, farthest_m)}
    return told, known, figures | {"coc_px": (coc_px.min(), coc_px.max())}


def _size_px(sharp: Sequence[Layer]) -> str:
    """Width x height of what is put in."""
    rows, columns = np.nonzero(np.maximum.reduce([layer.alpha for layer in sharp]) > 0.5)
    return f"{np.ptp(columns) + 1}x{np.ptp(rows) + 1}"


def nothing_seen(standing: ObjectOptions, virtual: VirtualOptions) -> None:
    """Raise InputError if what was rendered is not in the picture; an empty layer of another program is only warned of."""
    if standing.object_ is not None:
        where = f"--at-pixel {standing.at_pixel}" if standing.at_pixel else f"--at {standing.at}"
        raise InputError(
            f"nothing of {standing.object_} is in the picture: by {where} it stands beside the frame or is too small to be seen; choose "
            f"another place with --at X,Y,Z (metres right, down, forward of the lens) or --at-pixel X,Y, or another --height"
        )
    if virtual.scene is not None:
        raise InputError(f"nothing of {virtual.scene} is in the picture: its objects are beside the frame or behind the --camera")
    warn("nothing of the layers is in the picture: their alpha is 0 everywhere")


def placing_warning(sharp: Sequence[Layer], plate: Plate, mode: str, height: str | None) -> str | None:
    """Return a warning if an object is smaller than a pixel, reaches across the whole picture, or is mostly hidden; None else.

    height: the option --height as typed, which mends the first two.
    """
    alpha = np.maximum.reduce([layer.alpha for layer in sharp])
    rows, columns = np.nonzero(alpha > 0.5)
    unit = "its file may count in another unit: say --height METRES, or such as --height 200px"
    mend = f"--height {height} may be wrong" if height else unit
    if not alpha.any():
        return None
    if max(float(layer.alpha.sum()) for layer in sharp) < 1.0:
        return f"what is put in is smaller than a pixel; {mend}"
    whole = len(rows) and (np.ptp(rows) + 1, np.ptp(columns) + 1) == alpha.shape
    if whole:
        return f"what is put in reaches across the whole picture; {mend}"
    if plate.depth_m is None or mode == "front":
        return None
    depth_m = np.minimum.reduce([np.where(layer.alpha > 0.5, layer.depth_m, np.inf) for layer in sharp])
    hidden = float(nearer_than(plate.depth_m, depth_m, _NEARER).sum() / max(1, np.isfinite(depth_m).sum()))
    if hidden < _MUCH_HIDDEN:
        return None
    return f"{hidden:.0%} of it lies behind what the depth says is nearer; --mode front ignores depth"


def write_results(
    out: Path, inserted: Inserted, plate: Plate, sharp: Sequence[Layer], colour: ColourOptions, result: ResultOptions
) -> None:
    """Write the picture and the files beside it. sharp: the inserted layers, front first."""
    from mrbokeh.images.image_io import write_layer
    from mrbokeh.stacks.exr_layers.composite_exr import write_deep_exr

    write_picture(out, inserted, plate, sharp, colour)
    if result.save_layer is not None:
        write_layer(result.save_layer, inserted.virtual)
    if result.save_deep is not None:
        write_deep_exr(result.save_deep, sharp)


def write_picture(out: Path, inserted: Inserted, plate: Plate, sharp: Sequence[Layer], colour: ColourOptions) -> None:
    """Write the picture alone if it has an output space; else linear Rec.709 with its layers, or sRGB."""
    from mrbokeh.images.alpha_io import write_finished

    if out.suffix.lower() == ".exr" and colour.of_result is None:
        _write_layers(out, inserted, plate, flatten(sharp))
    else:
        write_finished(out, inserted.rgb, alpha_with(plate.alpha, inserted.virtual.alpha), colour.of_result)


def alpha_lost(out: Path, plate: Plate) -> str | None:
    """Return a warning if the plate's alpha cannot be kept, else None."""
    if plate.alpha is None or out.suffix.lower() in HOLDING_ALPHA:
        return None
    return f"the plate has alpha, which {out.suffix} cannot hold: what it does not cover is black in {out} (write .png, .tif or .exr)"


def _write_layers(out: Path, inserted: Inserted, plate: Plate, sharp: Layer) -> None:
    """Depth is that of the frontmost sharp surface; circles of confusion follow from it."""
    from mrbokeh.stacks.exr_layers.composite_exr import CompositeLayers, write_composite_exr

    scene_m = np.full(sharp.depth_m.shape, np.inf, np.float32) if plate.depth_m is None else plate.depth_m
    depth_m = np.where(sharp.alpha > 0.5, np.minimum(sharp.depth_m, scene_m), scene_m).astype(np.float32)
    coc_px = plate.lens.coc_px(depth_m, depth_m.shape[1]).astype(np.float32)
    alpha = alpha_with(plate.alpha, inserted.virtual.alpha)
    layers = {"virtual": _bare(inserted.virtual), "sharp": _bare(sharp)}
    write_composite_exr(
        out, CompositeLayers(rgb=inserted.rgb, alpha=alpha, depth_m=depth_m, layers=layers, matte=inserted.virtual.alpha, coc_px=coc_px)
    )


def _bare(layer: Layer) -> Layer:
    return Layer(layer.rgb, layer.alpha, layer.depth_m)


if TYPE_CHECKING:
    from mrbokeh.commands._composite_kept import KeptParts
    from mrbokeh.scene.staging.filming import Filming
    from mrbokeh.scene.staging.scene_description import Lighting
    from mrbokeh.stacks.exr_layers.deep_layers import DeepSamples

_COVERED = 0.5
_HIGHEST, _NEARER, _MUCH_HIDDEN = 20.0, 0.03, 0.4
_DARK = 0.6
"""How dark the shadow of a light is, where nothing tells."""

LayersFor = Callable[[Plate], list[Layer]]
"""The same scene for every plate of one view: sharp layers, front first."""


def layers_by(
    virtual: VirtualOptions,
    standing: ObjectOptions,
    rendering: RenderingOptions,
    first: Plate,
    bundle: CaptureBundle | None,
    kept: "KeptParts | None" = None,
) -> LayersFor:
    """Return the layers of the options. first: the plate on whose pixel the object stands. kept: from earlier pictures of the photograph.

    Raises InputError if there is nothing to insert.
    """
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
