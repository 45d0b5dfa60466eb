"""The plate of `mrbokeh composite`, as options say, and the way in which layers go into it."""

from dataclasses import dataclass, replace
from pathlib import Path

from mrbokeh.capture_bundle import CaptureBundle
from mrbokeh.compositing.base import Insertion
from mrbokeh.compositing.choose import insertion_of
from mrbokeh.depth_sources.depth_settings import DepthSettings, parse_near_far
from mrbokeh.errors import InputError
from mrbokeh.exr_io import read_exr
from mrbokeh.image_io import read_image
from mrbokeh.lens import Lens
from mrbokeh.plate import Plate, bundle_plate, open_plate, with_depth, with_matte


@dataclass(frozen=True)
class PlateOptions:
    """disparity: NEAR:FAR as typed. input_space: of OpenColorIO, in which the photograph's numbers are; ocio: the configuration."""

    photo: Path
    slice_index: int | None
    focus_m: float | None
    depth: Path | None
    disparity: str | None
    depth_scale: float | None
    matte: Path | None
    input_space: str | None
    ocio: str


def plate_by(options: PlateOptions, lens: Lens | None, bundle: CaptureBundle | None) -> Plate:
    """The photograph, slice or bundle, with depth and matte where files of them are given."""
    if bundle is None:
        plate = open_plate(options.photo, options.slice_index, lens, options.focus_m)
    else:
        plate = bundle_plate(bundle, lens, options.focus_m)
    if options.input_space is not None:
        plate = _from_space(plate, options)
    if options.depth is not None:
        near_far_m = None if options.disparity is None else parse_near_far(options.disparity)
        plate = with_depth(plate, options.depth, DepthSettings(near_far_m, options.depth_scale))
    return plate if options.matte is None else with_matte(plate, options.matte)


def insertion_for(mode: str | None, plate: Plate, near_m: float | None = None) -> Insertion:
    """By name; else the best that what is known of the plate allows. near_m: how far what the plate's matte holds is."""
    return insertion_of(mode or _best_mode(plate), near_m)


def _best_mode(plate: Plate) -> str:
    if plate.near_alpha is not None or (plate.depth_m is not None and plate.sharp_rgb is not None):
        return "between"
    return "over" if plate.depth_m is not None else "front"


def _from_space(plate: Plate, options: PlateOptions) -> Plate:
    """The photograph's own numbers, brought from their space to linear Rec.709."""
    from mrbokeh.color_management import ColorConversion

    if options.photo.is_dir() or options.input_space is None:
        raise InputError(f"--input-space is for a photograph in a file, but {options.photo} is a folder that states its colours itself")
    is_exr = options.photo.suffix.lower() == ".exr"
    stored = read_exr(options.photo)[0].stacked("RGB") if is_exr else read_image(options.photo, "linear")
    if stored.shape != plate.rgb.shape:
        raise InputError(f"--input-space takes {options.photo} as it is stored, but it is to be turned: turn it first")
    return replace(plate, rgb=ColorConversion.to_rec709(options.ocio, options.input_space).applied(stored))
