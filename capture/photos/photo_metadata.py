"""Shooting data of one photograph; the width of its sensor follows from pixel pitch, size of the picture, model or 35 mm equivalent."""

import math
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from datetime import datetime
from functools import cache
from typing import TYPE_CHECKING

from capture.photos.focus_metadata import FocusReading, Tags, number, rational
from mrbokeh.images.exif import as_it_lies, is_same_shape

if TYPE_CHECKING:
    import lensfunpy

# A RAW shows a few pixels more than the JPEG of its camera; a picture that differs by more was resized or cut.
_MARGIN = 0.05
FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_INCH_MM = 25.4
_PLAUSIBLE_WIDTH_MM = (1.0, 80.0)


@dataclass(frozen=True)
class SensorReading:
    """Size of a sensor's pixels: millimetres per pixel in a picture of full_size_px (width, height), if that size is known.

    source: the tag it came from.
    """

    pitch_mm: float
    full_size_px: tuple[int, int] | None
    source: str

    def width_mm(self, width_px: int, height_px: int) -> float:
        """Return the width on the sensor of a picture as it is stored.

        The full size, or nearly (RAW margins): pitch times width. Another size but the same shape: the picture was
        resized and shows the full width. Another shape: it was cut out, at full resolution as far as anyone can tell.
        """
        if self.full_size_px is None:
            return self.pitch_mm * width_px
        full_width, full_height = as_it_lies(self.full_size_px, (width_px, height_px))
        resized = abs(width_px / full_width - 1.0) > _MARGIN
        same_shape = is_same_shape((width_px, height_px), (full_width, full_height))
        return self.pitch_mm * (full_width if resized and same_shape else width_px)


def read_sensor(tags: Tags, focal_length_mm: float | None, stored_size_px: tuple[int, int] | None) -> SensorReading | None:
    """Return the sensor by exiv2's tags: FocalPlaneXResolution, Nikon's pixel size, Canon's focal plane, the model, 35 mm equivalent.

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


def stated_size_px(tags: Tags) -> tuple[int, int] | None:
    """Return width and height of the picture that the camera took. A reduced DNG states it as OriginalDefaultFinalSize."""
    original = tags.get("Exif.Image.OriginalDefaultFinalSize", "").split()
    if len(original) == 2:
        width_px, height_px = (number(each) for each in original)
    else:
        width_px, height_px = number(tags.get("Exif.Photo.PixelXDimension")), number(tags.get("Exif.Photo.PixelYDimension"))
    return (int(width_px), int(height_px)) if width_px and height_px else None


def sensor_of_model(make: str | None, model: str | None, size_px: tuple[int, int] | None) -> SensorReading | None:
    """Return the sensor of a camera whose full pictures have size_px (width, height), by lensfun's database (CC-BY-SA 3.0, in its wheel).

    The crop factor compares diagonals, rounded to about 0.5 % (Nikon D3300: 23.64 mm by it, 23.5 by the data sheet). None where lensfun is
    not installed or does not know the model.
    """
    database = _database() if make and model and size_px else None
    if database is None or size_px is None:
        return None
    found = next(iter(database.find_cameras(make, model)), None)
    if found is None or found.crop_factor <= 0:
        return None
    diagonal_mm = FULL_FRAME_DIAGONAL_MM / found.crop_factor
    return SensorReading(diagonal_mm / math.hypot(*size_px), size_px, f"lensfun's crop factor {found.crop_factor:.4g} of {found.model}")


@cache
def _database() -> "lensfunpy.Database | None":
    try:
        import lensfunpy
    except ImportError:
        return None
    return lensfunpy.Database()


def _is_plausible(reading: SensorReading, size_px: tuple[int, int] | None) -> bool:
    size_px = reading.full_size_px or size_px
    return size_px is None or _PLAUSIBLE_WIDTH_MM[0] < reading.pitch_mm * size_px[0] < _PLAUSIBLE_WIDTH_MM[1]


def _focal_plane_resolution(tags: Tags, size_px: tuple[int, int] | None) -> SensorReading | None:
    name = "Exif.Photo.FocalPlaneXResolution"
    per_unit = number(tags.get(name))
    unit = int(number(tags.get("Exif.Photo.FocalPlaneResolutionUnit")) or 2)
    if not per_unit or per_unit <= 0 or unit not in _MM_PER_UNIT:
        return None
    return SensorReading(_MM_PER_UNIT[unit] / per_unit, size_px, name)


def _nikon_pixel_size(tags: Tags, size_px: tuple[int, int] | None) -> SensorReading | None:
    """Read micrometres per pixel from Nikon's maker note."""
    micrometres = number(tags.get("Exif.Nikon3.SensorPixelSize"))
    return SensorReading(micrometres / 1000.0, size_px, "Exif.Nikon3.SensorPixelSize") if micrometres and micrometres > 0 else None


def _canon_focal_plane(tags: Tags, size_px: tuple[int, int] | None) -> SensorReading | None:
    """Read Canon's "type, focal length, width, height" in thousandths of an inch; newer bodies leave nonsense there."""
    values = [number(each) or 0.0 for each in tags.get("Exif.Canon.FocalLength", "").split()]
    if len(values) != 4 or size_px is None or min(values[2:]) < 40 or not 1.2 < values[2] / values[3] < 1.6:
        return None
    return SensorReading(values[2] * _INCH_MM / 1000.0 / size_px[0], size_px, "Exif.Canon.FocalLength")


def _film_equivalent(tags: Tags, focal_length_mm: float | None, size_px: tuple[int, int] | None) -> SensorReading | None:
    """Compute from FocalLengthIn35mmFilm, which compares diagonals with that of 36 x 24 mm (CIPA DCG-001), rounded to a millimetre."""
    name = "Exif.Photo.FocalLengthIn35mmFilm"
    equivalent = rational(tags.get(name))
    if not equivalent or equivalent[0] <= 0 or not focal_length_mm or size_px is None:
        return None
    diagonal_mm = FULL_FRAME_DIAGONAL_MM * focal_length_mm / (equivalent[0] / (equivalent[1] or 1))
    return SensorReading(diagonal_mm / math.hypot(*size_px), size_px, name)


@dataclass(frozen=True)
class StatedExposure:
    """Exposure as stated: the signal of a scene is proportional to time_s x ISO / f-number squared, so far as the camera keeps its word.

    f_number: None with lenses that do not tell the camera, whose aperture is taken to stay as it is.
    """

    time_iso_s: float
    f_number: float | None = None

    def gain_to(self, other: "StatedExposure") -> float | None:
        """Return the factor from this exposure to another; None where only one of them states its f-number."""
        if self.f_number is None and other.f_number is None:
            return other.time_iso_s / self.time_iso_s
        if self.f_number is None or other.f_number is None:
            return None
        return other.time_iso_s / self.time_iso_s * (self.f_number / other.f_number) ** 2


@dataclass(frozen=True)
class PhotoMetadata:
    """Shooting data of one photograph; None is unknown.

    taken_size_px: width and height of the picture that the camera took, as it states them; what is cut or resized has others.
    orientation: the EXIF tag (1 is upright), which nobody applies here.
    lens_position: where the focus drive of the lens stood, in the maker's steps (Nikon Z), finer than its distances.
    hiatus_mm: distance between the principal planes of the lens, which no file states.
    """

    focal_length_mm: float | None = None
    f_number: float | None = None
    exposure_time_s: float | None = None
    iso: float | None = None
    taken_at: datetime | None = None
    camera_model: str | None = None
    lens_model: str | None = None
    focus: FocusReading | None = None
    sensor: SensorReading | None = None
    orientation: int | None = None
    taken_size_px: tuple[int, int] | None = None
    lens_position: int | None = None
    hiatus_mm: float = 0.0

    def filled_from(self, other: "PhotoMetadata") -> "PhotoMetadata":
        """Return the data with what is unknown here taken from another source."""
        gaps = {each.name: getattr(other, each.name) for each in fields(self) if getattr(self, each.name) is None}
        return replace(self, **gaps)

    @property
    def exposure(self) -> "StatedExposure | None":
        if not self.exposure_time_s or not self.iso:
            return None
        return StatedExposure(self.exposure_time_s * self.iso, self.f_number or None)

    @property
    def focus_distance_m(self) -> float | None:
        """Return the focus distance from the front principal plane of the lens, or None."""
        return None if self.focus is None else self.focus.lens_distance_m(self.focal_length_mm, self.hiatus_mm)

    @property
    def focus_interval_m(self) -> tuple[float, float] | None:
        """Return (nearest, farthest) from there: what the statement may stand for."""
        return None if self.focus is None else self.focus.lens_interval_m(self.focal_length_mm, self.hiatus_mm)


def parse_time(text: str | None) -> datetime | None:
    """Parse EXIF's "2024:05:31 12:00:00"; None for "0000:00:00 00:00:00" and the like."""
    try:
        return datetime.strptime((text or "").strip()[:19], "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
