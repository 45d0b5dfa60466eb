"""The files of the simulated camera: 16-bit TIFF with EXIF, its focus distance as coarse as real cameras state it.

TIFF and not DNG: a mosaic would need a model of a sensor, which is data sets' business, and RAW adds nothing to what a bracket
has to prove. 16 bits keep the light linear to 0.01 %, and the file takes the way of every other photograph.
"""

import math
from collections.abc import Callable
from datetime import datetime
from fractions import Fraction

import cv2
import numpy as np
from jaxtyping import Float32

from capture.tether.camera_driver import CameraError
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.optics.lens import Lens, film_plane_m
from mrbokeh.system.errors import MissingExtraError

Rgb = Float32[np.ndarray, "height width 3"]
CAMERA_MODEL = "Simulated Thin Lens"
ELECTRONS_AT_WHITE = 40000.0
_NIKON_LARGEST = 254
_FINE = 100000
_CENTIMETRES = 3

FocusQuantum = Callable[[float], float | None]


def nikon_code(distance_m: float) -> float:
    """The distance that Nikon's 8-bit code stands for: 0.01 * 10^(v / 40) m, steps of 5.9 %."""
    code = _NIKON_LARGEST if math.isinf(distance_m) else min(round(40.0 * math.log10(distance_m / 0.01)), _NIKON_LARGEST)
    return float(0.01 * 10.0 ** (code / 40.0))


def to_centimetre(distance_m: float) -> float | None:
    """Whole centimetres; infinity is not stated."""
    return None if math.isinf(distance_m) else round(distance_m, 2)


def unstated(distance_m: float) -> None:  # noqa: ARG001
    """Most cameras say nothing."""
    return


def exposed(light: Rgb, rng: np.random.Generator) -> Rgb:
    """Photon noise on light whose 1.0 fills the sensor, then the sensor's limit."""
    electrons = rng.poisson(np.clip(light, 0.0, 2.0) * ELECTRONS_AT_WHITE)
    return np.minimum(electrons / ELECTRONS_AT_WHITE, 1.0).astype(np.float32)


def encoded_tiff(rgb: Rgb, exif: dict[str, str]) -> bytes:
    """A 16-bit sRGB TIFF in memory, with EXIF."""
    try:
        import pyexiv2
    except ImportError:
        raise MissingExtraError("pyexiv2", "capture") from None
    integers = np.round(np.clip(linear_to_srgb(rgb), 0.0, 1.0) * 65535.0).astype(np.uint16)
    done, data = cv2.imencode(".tif", np.ascontiguousarray(integers[..., ::-1]))
    if not done:
        raise CameraError(f"the simulated camera cannot encode a picture of shape {rgb.shape}")
    with pyexiv2.ImageData(data.tobytes()) as image:
        image.modify_exif(exif)
        return bytes(image.get_bytes())


def exif_of(lens: Lens, width_px: int, exposure_time_s: float, iso: float, taken_at: datetime, quantum: FocusQuantum) -> dict[str, str]:
    """The Exif directory as a camera writes it. quantum: distance from the film plane to the one that is stated, or None."""
    per_cm = Fraction(width_px * 10) / Fraction(str(lens.sensor_width_mm))
    stated = quantum(film_plane_m(lens))
    exif = {
        "Exif.Image.Make": "mrbokeh",
        "Exif.Image.Model": CAMERA_MODEL,
        "Exif.Photo.ExposureTime": _rational(exposure_time_s, 1000000),
        "Exif.Photo.FNumber": _rational(lens.f_number, 100),
        "Exif.Photo.ExposureProgram": "1",
        "Exif.Photo.ISOSpeedRatings": str(round(iso)),
        "Exif.Photo.DateTimeOriginal": taken_at.strftime("%Y:%m:%d %H:%M:%S"),
        "Exif.Photo.FocalLength": _rational(lens.focal_length_mm, 100),
        "Exif.Photo.FocalPlaneXResolution": f"{per_cm.numerator}/{per_cm.denominator}",
        "Exif.Photo.FocalPlaneYResolution": f"{per_cm.numerator}/{per_cm.denominator}",
        "Exif.Photo.FocalPlaneResolutionUnit": str(_CENTIMETRES),
    }
    return exif if stated is None else exif | {"Exif.Photo.SubjectDistance": _rational(stated, _FINE if stated < 1000.0 else 1)}


def _rational(value: float, denominator: int) -> str:
    return f"{round(value * denominator)}/{denominator}"
