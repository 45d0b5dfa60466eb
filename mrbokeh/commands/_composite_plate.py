"""The plate of `mrbokeh composite`, as options say, and the way in which layers go into it."""

from dataclasses import replace
from pathlib import Path

from mrbokeh.commands._composite_options import PlateOptions
from mrbokeh.commands._insertion_options import ColourOptions
from mrbokeh.compositing.plate import Plate, bundle_plate, open_plate, with_depth, with_matte, with_own_alpha
from mrbokeh.depth.depth_map import DepthSettings, parse_near_far
from mrbokeh.images.color_management import NamedSpace
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.capture_bundle import CaptureBundle
from mrbokeh.system.errors import InputError
from mrbokeh.video.picture_sources.stored_numbers import read_numbers


def plate_by(
    photo: Path, options: PlateOptions, colour: ColourOptions, bundle: CaptureBundle | None, *, lens: Lens | None, focus_m: float | None
) -> Plate:
    """The photograph, slice or bundle, with depth and matte where files of them are given; lens, focus_m: in place of its own."""
    if bundle is None:
        plate = open_plate(photo, 0 if options.all_slices else options.slice_, lens, focus_m)
    else:
        plate = bundle_plate(bundle, lens, focus_m)
    if colour.of_plate is not None:
        plate = _from_space(plate, photo, colour.of_plate)
    if options.depth is not None:
        near_far_m = None if options.disparity is None else parse_near_far(options.disparity)
        plate = with_depth(plate, options.depth, DepthSettings(near_far_m, options.depth_scale))
    return plate if options.matte is None else with_matte(plate, options.matte)


def best_mode(plate: Plate) -> str:
    """That what is known of the plate allows."""
    if plate.near_alpha is not None or (plate.depth_m is not None and plate.sharp_rgb is not None):
        return "between"
    return "over" if plate.depth_m is not None else "front"


def _from_space(plate: Plate, photo: Path, space: NamedSpace) -> Plate:
    """The photograph's own numbers, brought from their space to linear Rec.709."""
    if photo.is_dir():
        raise InputError(f"--input-space is for a photograph in a file, but {photo} is a folder that states its colours itself")
    stored = read_numbers(photo)
    if stored.shape != plate.rgb.shape:
        raise InputError(f"--input-space takes {photo} as it is stored, but it is to be turned: turn it first")
    return with_own_alpha(replace(plate, rgb=space.to_rec709(stored)), photo, plate.alpha)
