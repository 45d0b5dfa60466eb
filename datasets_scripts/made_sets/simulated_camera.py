"""A simulated digital camera: scene-linear Rec.709 in, Bayer mosaic with photon and read noise, DNG files out.

DNG files (Adobe DNG 1.4) are uncompressed mosaics with colour, lens and focus metadata that raw converters open. EXIF SubjectDistance
counts from the film plane, Lens.focus_distance_m from the lens (`mrbokeh.optics.lens.film_plane_m`).
"""

from dataclasses import dataclass
from datetime import datetime
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16

from mrbokeh.images.color import XYZ_from_rec709
from mrbokeh.optics.lens import Lens, film_plane_m
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError

CFA_PATTERNS = {"RGGB": (0, 1, 1, 2), "BGGR": (2, 1, 1, 0), "GRBG": (1, 0, 2, 1), "GBRG": (1, 2, 0, 1)}
# How a plausible white-balanced camera sees linear Rec.709 (rows sum to 1), and what it answers to D65 white before white balance.
_BALANCED_CAMERA_FROM_REC709 = np.array([[0.68, 0.26, 0.06], [0.16, 0.70, 0.14], [0.04, 0.22, 0.74]])
_ANSWER_TO_WHITE = np.array([0.5, 1.0, 0.625])
_MATRIX_DENOMINATOR = 10000
_FINE_DENOMINATOR = 1000000
_DISTANCE_DENOMINATOR = 100000
_D65_ILLUMINANT = 21
_CFA_PHOTOMETRIC = 32803
_CENTIMETRES = 3
_MANUAL_EXPOSURE = 1


def _default_camera_from_xyz() -> Float[np.ndarray, "3 3"]:
    exact = np.diag(_ANSWER_TO_WHITE) @ _BALANCED_CAMERA_FROM_REC709 @ np.linalg.inv(XYZ_from_rec709)
    return np.round(exact * _MATRIX_DENOMINATOR) / _MATRIX_DENOMINATOR


@dataclass(frozen=True)
class SensorModel:
    """Colour, range and noise of a sensor.

    camera_from_xyz: the matrix that the DNG states as ColorMatrix1 (D65), already rounded to what the file can hold.
    exposure: raw green, as a share of its range, for scene-linear white (1, 1, 1).
    footprint_px: side of the square over which a photosite averages; above 1 by the optical low-pass filter before it.
    full_well_electrons: electrons at raw white. read_noise_electrons: standard deviation. Either None or 0 turns noise off.
    """

    bits: int = 14
    black_level: int = 1008
    pattern: str = "RGGB"
    exposure: float = 1.0
    footprint_px: float = 1.5
    full_well_electrons: float = 60000.0
    read_noise_electrons: float = 3.0
    camera_from_xyz: tuple[tuple[float, ...], ...] = tuple(map(tuple, _default_camera_from_xyz().tolist()))

    def __post_init__(self) -> None:
        if self.pattern not in CFA_PATTERNS or not 12 <= self.bits <= 16 or not 0 <= self.black_level < self.white_level:
            raise InputError(
                f"expected a pattern of {', '.join(CFA_PATTERNS)}, 12 to 16 bits and a black level below white, "
                f"got {self.pattern}, {self.bits} bits, black level {self.black_level}"
            )

    @property
    def white_level(self) -> int:
        return 2**self.bits - 1

    @property
    def camera_from_rec709(self) -> Float[np.ndarray, "3 3"]:
        """Raw camera RGB of linear Rec.709, scaled so that white (1, 1, 1) answers 1 in green."""
        matrix = np.asarray(self.camera_from_xyz) @ XYZ_from_rec709
        return matrix / matrix[1].sum()

    @property
    def as_shot_neutral(self) -> Float[np.ndarray, "3"]:
        """Camera RGB of white: the white balance multipliers are its inverse."""
        return self.camera_from_rec709.sum(axis=1)

    def cfa_colours(self, height: int, width: int) -> UInt8[np.ndarray, "height width"]:
        """Return (H, W): 0 red, 1 green, 2 blue under each photosite."""
        cell = np.asarray(CFA_PATTERNS[self.pattern], np.uint8).reshape(2, 2)
        return np.tile(cell, (height // 2 + 1, width // 2 + 1))[:height, :width]

    def linear_mosaic(self, rgb: Float[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "height width"]:
        """Turn scene-linear Rec.709 into the noise-free share of the raw range at each photosite; may exceed 1 (not clipped yet)."""
        camera_rgb = self.exposure * (rgb @ self.camera_from_rec709.T.astype(rgb.dtype))
        colours = self.cfa_colours(*rgb.shape[:2])
        return np.take_along_axis(camera_rgb, colours[..., None].astype(np.intp), axis=2)[..., 0].astype(np.float32)

    def expose(self, mosaic: Float[np.ndarray, "height width"], rng: np.random.Generator) -> Float32[np.ndarray, "height width"]:
        """Add photon noise (Poisson, saturating at the full well) and read noise (Gaussian) to a noise-free mosaic."""
        if not self.full_well_electrons:
            return np.minimum(mosaic, 1.0).astype(np.float32)
        electrons = rng.poisson(np.maximum(mosaic, 0.0) * self.full_well_electrons)
        read = rng.normal(0.0, self.read_noise_electrons, mosaic.shape)
        return (np.minimum(electrons + read, self.full_well_electrons) / self.full_well_electrons).astype(np.float32)

    def quantise(self, mosaic: Float[np.ndarray, "height width"]) -> UInt16[np.ndarray, "height width"]:
        """Turn shares of the raw range into integers: black level at 0, white level at 1, clipped to the converter's range."""
        values = self.black_level + mosaic.astype(np.float64) * (self.white_level - self.black_level)
        return np.clip(np.round(values), 0, self.white_level).astype(np.uint16)

    def photograph(self, rgb: Float[np.ndarray, "height width 3"], rng: np.random.Generator) -> UInt16[np.ndarray, "height width"]:
        """Turn scene-linear Rec.709 into the raw integers of one exposure."""
        return self.quantise(self.expose(self.linear_mosaic(rgb), rng))


@dataclass(frozen=True)
class ShotMetadata:
    """Metadata that the camera writes beside the pixels."""

    lens: Lens
    exposure_time_s: Fraction = Fraction(1, 60)
    iso: int = 100
    taken_at: datetime = datetime(2025, 6, 1, 12, 0, 0)
    camera_make: str = "mrbokeh"
    camera_model: str = "Simulated Bayer Camera"
    lens_model: str = "Thin Lens"


def write_dng(path: Path, mosaic: UInt16[np.ndarray, "height width"], sensor: SensorModel, shot: ShotMetadata) -> None:
    """Write a mosaic as DNG, atomically: first under a temporary name, metadata included, then renamed."""
    import pyexiv2
    import tifffile

    with atomic_path(path) as temporary:
        tifffile.imwrite(
            temporary, mosaic, photometric=_CFA_PHOTOMETRIC, compression=None, metadata=None, software="mrbokeh", subfiletype=0,
            rowsperstrip=mosaic.shape[0], extratags=_dng_tags(sensor, shot),
        )  # fmt: skip
        with pyexiv2.Image(str(temporary)) as image:
            image.modify_exif(_exif(shot, mosaic.shape[1]))


def _dng_tags(sensor: SensorModel, shot: ShotMetadata) -> list[tuple[int, str | int, int, Any, bool]]:
    """Return TIFF/EP and DNG tags of the image directory: (code, type, count, value, write once)."""
    baseline_exposure_ev = -float(np.log2(sensor.exposure))
    return [
        (271, "s", 0, shot.camera_make, True),
        (272, "s", 0, shot.camera_model, True),
        (274, "H", 1, 1, True),  # Orientation: as stored
        (306, "s", 0, _exif_time(shot.taken_at), True),
        (33421, "H", 2, (2, 2), True),  # CFARepeatPatternDim
        (33422, "B", 4, bytes(CFA_PATTERNS[sensor.pattern]), True),  # CFAPattern
        (50706, "B", 4, bytes([1, 4, 0, 0]), True),  # DNGVersion
        (50707, "B", 4, bytes([1, 1, 0, 0]), True),  # DNGBackwardVersion
        (50708, "s", 0, f"{shot.camera_make} {shot.camera_model}", True),  # UniqueCameraModel
        (50713, "H", 2, (1, 1), True),  # BlackLevelRepeatDim
        (50714, "I", 1, sensor.black_level, True),
        (50717, "I", 1, sensor.white_level, True),
        (50721, "2i", 9, _rationals(np.asarray(sensor.camera_from_xyz), _MATRIX_DENOMINATOR), True),  # ColorMatrix1
        (50728, "2I", 3, _rationals(sensor.as_shot_neutral, _FINE_DENOMINATOR), True),
        (50730, "2i", 1, _rationals(np.array([baseline_exposure_ev]), _FINE_DENOMINATOR), True),  # BaselineExposure
        (50778, "H", 1, _D65_ILLUMINANT, True),  # CalibrationIlluminant1
    ]


def _exif(shot: ShotMetadata, width_px: int) -> dict[str, str]:
    """Return the Exif directory; FocalPlaneX/YResolution with a square pixel pitch tell the size of the sensor."""
    lens = shot.lens
    pixels_per_cm = Fraction(width_px * 10) / Fraction(str(lens.sensor_width_mm))
    distance = "4294967295/1" if np.isinf(lens.focus_distance_m) else _rational_text(film_plane_m(lens), _DISTANCE_DENOMINATOR)
    return {
        "Exif.Photo.ExposureTime": f"{shot.exposure_time_s.numerator}/{shot.exposure_time_s.denominator}",
        "Exif.Photo.FNumber": _rational_text(lens.f_number, 100),
        "Exif.Photo.ExposureProgram": str(_MANUAL_EXPOSURE),
        "Exif.Photo.ISOSpeedRatings": str(shot.iso),
        "Exif.Photo.DateTimeOriginal": _exif_time(shot.taken_at),
        "Exif.Photo.FocalLength": _rational_text(lens.focal_length_mm, 100),
        "Exif.Photo.SubjectDistance": distance,
        "Exif.Photo.FocalPlaneXResolution": f"{pixels_per_cm.numerator}/{pixels_per_cm.denominator}",
        "Exif.Photo.FocalPlaneYResolution": f"{pixels_per_cm.numerator}/{pixels_per_cm.denominator}",
        "Exif.Photo.FocalPlaneResolutionUnit": str(_CENTIMETRES),
        "Exif.Photo.LensModel": shot.lens_model,
    }


def _exif_time(taken_at: datetime) -> str:
    return taken_at.strftime("%Y:%m:%d %H:%M:%S")


def _rational_text(value: float, denominator: int) -> str:
    return f"{round(value * denominator)}/{denominator}"


def _rationals(values: Float[np.ndarray, "..."], denominator: int) -> list[int]:
    return [number for value in values.ravel() for number in (round(float(value) * denominator), denominator)]
