"""Distortion of a lens out of lensfun's database (CC-BY-SA 3.0, in the lensfunpy wheel), by the names of camera and lens."""

from typing import TYPE_CHECKING

import numpy as np

from mrbokeh.distortion.distortion import LensDistortion
from mrbokeh.distortion.models import IN_LENGTHS, PARAMETERS, radial
from mrbokeh.system.errors import InputError, MissingExtraError

if TYPE_CHECKING:
    import lensfunpy

_ASPECTS = (3 / 2, 4 / 3, 16 / 9, 1.0)
"""All aspect ratios of calibrations in the database, the usual first. The binding does not tell which one a lens has."""
_SIDE_PX = 2001
_SURE = 90
"""Score of a loose search, of 100, from which on a camera is the one that was meant: its next model scores 85."""


def lensfun_distortion(camera_model: str, lens_model: str, focal_mm: float, camera_make: str | None = None) -> LensDistortion:
    """The distortion of a rectilinear lens at a focal length, for the camera's full frame.

    Names as EXIF has them, found loosely. InputError where the database knows no such camera, lens or calibration.
    """
    camera, lens = _found(camera_make, camera_model, lens_model)
    import lensfunpy

    if lens.type != lensfunpy.LensType.RECTILINEAR:
        raise InputError(f"lensfun's {lens.model} is a fisheye, whose projection is no pinhole's: calibrate it and use the model fisheye")
    calibration = lens.interpolate_distortion(focal_mm)
    model = calibration.model.name.lower() if calibration is not None else "none"
    if model not in IN_LENGTHS:
        raise InputError(f"lensfun has no distortion of {lens.model} at {focal_mm:g} mm: calibrate the lens, or leave it undistorted")
    values = tuple(float(term) for term in calibration.terms[: len(PARAMETERS[model])])
    return LensDistortion(model, values, _unit_half_diagonals(lens, camera.crop_factor, focal_mm, (model, values)))


def _found(make: str | None, camera_model: str, lens_model: str) -> "tuple[lensfunpy.Camera, lensfunpy.Lens]":
    try:
        import lensfunpy
    except ModuleNotFoundError as missing:
        raise MissingExtraError("lensfunpy", "capture") from missing
    database = lensfunpy.Database()
    cameras = [each for each in database.find_cameras(make, camera_model, loose_search=True) if each.score >= _SURE]
    if not cameras:
        raise InputError(f"lensfun knows no camera {camera_model!r}: check the name in the EXIF data")
    lenses = database.find_lenses(cameras[0], None, lens_model, loose_search=True)
    if not lenses:
        raise InputError(f"lensfun knows no lens {lens_model!r} for {cameras[0].model}: check the name in the EXIF data")
    return cameras[0], lenses[0]


def _unit_half_diagonals(lens: "lensfunpy.Lens", crop: float, focal_mm: float, fit: tuple[str, tuple[float, ...]]) -> float:
    """Half the shorter side of the picture that was calibrated, in half diagonals of this camera's frame.

    Crop factors compare diagonals. The aspect ratio of the calibration is the one with which lensfun's own result is met.
    """
    import lensfunpy

    modifier = lensfunpy.Modifier(lens, crop, _SIDE_PX, _SIDE_PX)
    modifier.initialize(focal_mm, lens.min_aperture or 4.0, 1000.0, 1.0, flags=lensfunpy.ModifyFlags.DISTORTION)
    # One column at a time: where lensfun takes four pixels of a row at once, three of them are off by up to 0.2 px.
    column = np.asarray(modifier.apply_geometry_distortion(_SIDE_PX // 2, 0, 1, _SIDE_PX)).reshape(_SIDE_PX, 2)
    radius_px, half_px = np.arange(_SIDE_PX // 2 + 1.0), 0.5 * np.hypot(_SIDE_PX - 1, _SIDE_PX - 1)
    met_px = column[_SIDE_PX // 2 :, 1] - _SIDE_PX // 2

    def miss_px(unit: float) -> float:
        unit_px = unit * half_px
        return float(np.abs(radial(*fit, radius_px / unit_px)[0] * unit_px - met_px).max())

    return min((crop / (lens.crop_factor * float(np.hypot(1.0, aspect))) for aspect in _ASPECTS), key=miss_px)
