"""The width of the sensor from what a photograph states: pixel pitch, size of the picture it belongs to, model, 35 mm equivalent."""

import math
from collections.abc import Callable

from capture.photos.focus_metadata import Tags, number, rational
from capture.photos.sensor_reading import SensorReading
from capture.photos.sensor_table import FULL_FRAME_DIAGONAL_MM, sensor_of_model

_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_INCH_MM = 25.4
_PLAUSIBLE_WIDTH_MM = (1.0, 80.0)


def read_sensor(tags: Tags, focal_length_mm: float | None, stored_size_px: tuple[int, int] | None) -> SensorReading | None:
    """The sensor by exiv2's tags: FocalPlaneXResolution, Nikon's pixel size, Canon's focal plane, the model, 35 mm equivalent.

    stored_size_px: (width, height) of the file, for tags that speak of the whole frame where EXIF does not state its size.
    """
    size_px = stated_size_px(tags) or stored_size_px
    readers: tuple[Callable[[], SensorReading | None], ...] = (
        lambda: _focal_plane_resolution(tags, stated_size_px(tags)),
        lambda: _nikon_pixel_size(tags, stated_size_px(tags)),
        lambda: _canon_focal_plane(tags, size_px),
        lambda: sensor_of_model(tags.get("Exif.Image.Make"), tags.get("Exif.Image.Model"), size_px),
        lambda: _film_equivalent(tags, focal_length_mm, size_px),
    )
    return next((reading for reader in readers if (reading := reader()) is not None and _is_plausible(reading, size_px)), None)


def _is_plausible(reading: SensorReading, size_px: tuple[int, int] | None) -> bool:
    size_px = reading.full_size_px or size_px
    return size_px is None or _PLAUSIBLE_WIDTH_MM[0] < reading.pitch_mm * size_px[0] < _PLAUSIBLE_WIDTH_MM[1]


def stated_size_px(tags: Tags) -> tuple[int, int] | None:
    """Width and height of the picture that the camera took. A reduced DNG states it as OriginalDefaultFinalSize."""
    original = tags.get("Exif.Image.OriginalDefaultFinalSize", "").split()
    if len(original) == 2:
        width_px, height_px = (number(each) for each in original)
    else:
        width_px, height_px = number(tags.get("Exif.Photo.PixelXDimension")), number(tags.get("Exif.Photo.PixelYDimension"))
    return (int(width_px), int(height_px)) if width_px and height_px else None


def _focal_plane_resolution(tags: Tags, size_px: tuple[int, int] | None) -> SensorReading | None:
    name = "Exif.Photo.FocalPlaneXResolution"
    per_unit = number(tags.get(name))
    unit = int(number(tags.get("Exif.Photo.FocalPlaneResolutionUnit")) or 2)
    if not per_unit or per_unit <= 0 or unit not in _MM_PER_UNIT:
        return None
    return SensorReading(_MM_PER_UNIT[unit] / per_unit, size_px, name)


def _nikon_pixel_size(tags: Tags, size_px: tuple[int, int] | None) -> SensorReading | None:
    """Nikon's maker note: micrometres per pixel."""
    micrometres = number(tags.get("Exif.Nikon3.SensorPixelSize"))
    return SensorReading(micrometres / 1000.0, size_px, "Exif.Nikon3.SensorPixelSize") if micrometres and micrometres > 0 else None


def _canon_focal_plane(tags: Tags, size_px: tuple[int, int] | None) -> SensorReading | None:
    """Canon's maker note "type, focal length, width, height" in thousandths of an inch; newer bodies leave nonsense there."""
    values = [number(each) or 0.0 for each in tags.get("Exif.Canon.FocalLength", "").split()]
    if len(values) != 4 or size_px is None or min(values[2:]) < 40 or not 1.2 < values[2] / values[3] < 1.6:
        return None
    return SensorReading(values[2] * _INCH_MM / 1000.0 / size_px[0], size_px, "Exif.Canon.FocalLength")


def _film_equivalent(tags: Tags, focal_length_mm: float | None, size_px: tuple[int, int] | None) -> SensorReading | None:
    """FocalLengthIn35mmFilm compares diagonals with that of 36 x 24 mm (CIPA DCG-001); it is rounded to a millimetre."""
    name = "Exif.Photo.FocalLengthIn35mmFilm"
    equivalent = rational(tags.get(name))
    if not equivalent or equivalent[0] <= 0 or not focal_length_mm or size_px is None:
        return None
    diagonal_mm = FULL_FRAME_DIAGONAL_MM * focal_length_mm / (equivalent[0] / (equivalent[1] or 1))
    return SensorReading(diagonal_mm / math.hypot(*size_px), size_px, name)
