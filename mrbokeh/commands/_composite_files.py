"""Beginning and end of `mrbokeh composite`: opens the plate that its options name, writes the picture, its layers and files beside it."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mrbokeh.commands._composite_options import CompositeOptions, ResultOptions
from mrbokeh.commands._insertion_options import ColourOptions, near_far_of
from mrbokeh.compositing.open_plate import bundle_plate, open_plate, with_blur_in_metres, with_depth, with_stereo
from mrbokeh.compositing.plate import Inserted, Plate, read_matte, with_own_alpha
from mrbokeh.depth.depth_map import DepthSettings, parse_near_far, parse_stereo
from mrbokeh.depth.phone_depth import read_phone_photo
from mrbokeh.images.alpha_io import HOLDING_ALPHA, alpha_with, write_finished
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.image_io import INTEGER_SUFFIXES, require_suffix
from mrbokeh.images.layer import Layer, flatten
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.capture_bundle import CaptureBundle
from mrbokeh.stacks.guessed_metres import GUESSED
from mrbokeh.stacks.photograph import read_photograph
from mrbokeh.system.atomic_files import require_safe_outputs
from mrbokeh.system.console import flag
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say
from mrbokeh.video.image_sequence import read_numbers


def plate_by(whole: CompositeOptions, bundle: CaptureBundle | None, *, lens: Lens | None, focus_m: float | None) -> Plate:
    """Open the photograph, slice or bundle, with depth and matte from their files. lens, focus_m: in place of its own.

    Where the options guess the ground, facts of the lens that the photograph lacks are guessed too.
    """
    photo, options, colour, facts = whole.photo, whole.taken, whole.colour, {} if lens else whole.facts.given
    if facts and photo.is_dir():
        told = " and ".join(flag(name) for name in facts)
        raise InputError(f"{told} would change the lens that {photo} states itself: leave that out, or give --lens")
    if bundle is None:
        slice_index = 0 if options.all_slices else options.slice_
        plate = open_plate(photo, slice_index, lens, focus_m, facts, guessing=whole.guesses_ground, exact_depth=options.exact_depth)
    else:
        plate = bundle_plate(bundle, lens, focus_m)
    if colour.of_plate is not None:
        plate = _from_space(plate, photo, colour.of_plate)
    own = photo if options.disparity and not photo.is_dir() and read_phone_photo(photo, parse_near_far(options.disparity)) else None
    near_far_m = near_far_of(options.disparity, options.depth or own)
    if options.rgb is not None:
        plate = replace(plate, sharp_rgb=_rgb_of(options.rgb, colour))
    if options.stereo is not None:
        plate = with_stereo(plate, _rgb_of(options.stereo, colour), options.baseline, (photo, options.stereo), exact=options.exact_depth)
    source = options.depth or (photo if near_far_m or options.depth_scale else None)
    if source is not None:
        cameras = None if options.stereo_cameras is None else parse_stereo(options.stereo_cameras)
        settings = DepthSettings(near_far_m, options.depth_scale, cameras, exact=options.exact_depth)
        before_m, plate = plate.depth_m, with_depth(plate, source, settings)
        plate = replace(plate, depth_note="", metres_guessed=plate.metres_guessed and photo.is_dir())
        if own is not None and plate.blur_from and before_m is not None:
            plate = with_blur_in_metres(plate, before_m, focus_m)
    return plate if options.matte is None else replace(plate, near_alpha=read_matte(options.matte))


def _rgb_of(path: Path, colour: ColourOptions) -> Float32[np.ndarray, "height width 3"]:
    """Return another picture of the plate's view, in linear Rec.709."""
    return read_photograph(path).rgb if colour.of_plate is None else colour.of_plate.to_rec709(read_numbers(path))


def _from_space(plate: Plate, photo: Path, space: NamedSpace) -> Plate:
    """The photograph's own numbers, brought from their space to linear Rec.709."""
    if photo.is_dir():
        raise InputError(f"--input-space is for a photograph in a file, but {photo} is a folder that states its colours itself")
    stored = read_numbers(photo)
    if stored.shape != plate.rgb.shape:
        raise InputError(f"--input-space takes {photo} as it is stored, but it is to be turned: turn it first")
    return with_own_alpha(replace(plate, rgb=space.to_rec709(stored)), photo, plate.alpha)


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
    """Return a text on lens and blur, the known facts of the lens, and figures; if metres are guessed, figures in pixels only."""
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
    coc_px = np.abs(lens.coc_px(seen_m, width_px))
    size = f", {_size_px(sharp)} px" if plate.metres_guessed else ""
    far = f"{nearest_m:.3g} to {farthest_m:.3g} {unit} from the lens"
    told = f"{told}; put in at {far}{size}, blurred by {coc_px.min():.1f} to {coc_px.max():.1f} px"
    figures = {} if plate.metres_guessed else {"depths_m": (nearest_m, farthest_m)}
    return told, known, figures | {"coc_px": (coc_px.min(), coc_px.max())}


def _size_px(sharp: Sequence[Layer]) -> str:
    """Width x height of what is put in."""
    rows, columns = np.nonzero(np.maximum.reduce([layer.alpha for layer in sharp]) > 0.5)
    return f"{np.ptp(columns) + 1}x{np.ptp(rows) + 1}"


def write_results(out: Path, inserted: Inserted, plate: Plate, sharp: Sequence[Layer], options: CompositeOptions) -> None:
    """Write the picture and the files beside it. sharp: the inserted layers, front first. options: of the plate and its layers."""
    from mrbokeh.images.image_io import write_layer
    from mrbokeh.stacks.exr_layers.composite_exr import write_deep_exr

    result = options.result
    if out.suffix.lower() == ".exr":
        _write_layers(out, inserted, plate, flatten(sharp), options)
    else:
        write_finished(out, inserted.rgb, alpha_with(plate.alpha, inserted.virtual.alpha), options.colour.of_result)
    if result.save_layer is not None:
        write_layer(result.save_layer, inserted.virtual)
    if result.save_deep is not None:
        write_deep_exr(result.save_deep, sharp)


def alpha_lost(out: Path, plate: Plate) -> str | None:
    """Return a warning if the plate's alpha cannot be kept, else None."""
    if plate.alpha is None or out.suffix.lower() in HOLDING_ALPHA:
        return None
    return f"the plate has alpha, which {out.suffix} cannot hold: what it does not cover is black in {out} (write .png, .tif or .exr)"


def _write_layers(out: Path, inserted: Inserted, plate: Plate, sharp: Layer, options: CompositeOptions) -> None:
    """Write the EXR file with all layers. Depth is that of the frontmost sharp surface; circles of confusion follow from it."""
    from mrbokeh.images.carried_exr import CarriedExr
    from mrbokeh.stacks.exr_layers.composite_exr import CompositeLayers, write_composite_exr
    from mrbokeh.stacks.exr_layers.cryptomatte import cryptomatte_among
    from mrbokeh.stacks.exr_layers.sequence import ExrSequence

    colour = options.colour
    carried = CarriedExr.of(options.photo, colour.of_plate)
    if told := carried.told(options.photo):
        say(told)
    scene_m = np.full(sharp.depth_m.shape, np.inf, np.float32) if plate.depth_m is None else plate.depth_m
    depth_m = np.where(sharp.alpha > 0.5, np.minimum(sharp.depth_m, scene_m), scene_m).astype(np.float32)
    coc_px = plate.lens.coc_px(depth_m, depth_m.shape[1]).astype(np.float32)
    alpha = alpha_with(plate.alpha, inserted.virtual.alpha)
    layers = {"virtual": _bare(inserted.virtual), "sharp": _bare(sharp)}
    made = CompositeLayers(
        rgb=inserted.rgb,
        alpha=alpha,
        depth_m=depth_m,
        layers=layers,
        matte=inserted.virtual.alpha,
        coc_px=coc_px,
        objects=cryptomatte_among([each.path_of(each.frames[0]) for each in map(ExrSequence.of, options.virtual.layer or ())]),
    )
    write_composite_exr(out, made, space=colour.of_result, carried=carried)


def _bare(layer: Layer) -> Layer:
    return Layer(layer.rgb, layer.alpha, layer.depth_m)
