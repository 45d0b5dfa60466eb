"""Shooting data of one photograph; the width of its sensor follows from pixel pitch, size of the picture, model or 35 mm equivalent."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from datetime import datetime
from functools import cache
from typing import TYPE_CHECKING

from capture.photos.focus_metadata import FocusReading, Tags, number, rational
from mrbokeh.images.exif import as_it_lies, is_same_shape
from mrbokeh.optics.lens import MM_PER_M

if TYPE_CHECKING:
    import lensfunpy

# A RAW shows a few pixels more than the JPEG of its camera; a picture that differs by more was resized or cut.
_MARGIN = 0.05
FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_INCH_MM = 25.4
_PLAUSIBLE_MM = (3.0, 60.0)
"""Longer side of sensors that state their pixels."""
_AGREEING = 1.15
_CANONS_SHARE = 1000
_SHARP_PER_DIAGONAL, _ROUGH = 1.0 / 1500.0, 2.0
_SHORTEST_PER_DIAGONAL, _LEAST_F_NUMBER = 0.15, 0.7
"""A fisheye lens has a sixth of the diagonal as its focal length, and no lens for photographs is faster than f/0.7."""


@dataclass(frozen=True)
class SensorReading:
    """Size of a sensor's pixels: millimetres per pixel in a picture of full_size_px (width, height), if that size is known.

    source: the tag it came from. doubt: why it may be wrong, in words.
    """

    pitch_mm: float
    full_size_px: tuple[int, int] | None
    source: str
    doubt: str = ""

    @property
    def diagonal_mm(self) -> float:
        """Return the diagonal of the whole picture; inf if its size is unknown."""
        return math.inf if self.full_size_px is None else self.pitch_mm * math.hypot(*self.full_size_px)

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

    stored_size_px: (width, height) of the file, for tags that speak of the whole frame where EXIF does not state its size. Pixels that the
    model or the 35 mm equivalent contradict are not believed: programs that make a picture smaller leave them as they were.
    """
    taken_px, zoom = size_as_taken_px(tags), _digital_zoom(tags)
    size_px = taken_px or stored_size_px
    own: tuple[Callable[[], SensorReading | None], ...] = (
        lambda: _focal_plane_resolution(tags, taken_px),
        lambda: _nikon_pixel_size(tags, taken_px),
        lambda: _canon_focal_plane(tags, size_px),
    )
    others: tuple[Callable[[], SensorReading | None], ...] = (
        lambda: sensor_of_model(tags.get("Exif.Image.Make"), tags.get("Exif.Image.Model"), size_px, zoom),
        lambda: _film_equivalent(tags, focal_length_mm, size_px),
    )
    stated = next((reading for each in own if (reading := each()) is not None and _is_plausible(reading, size_px, zoom)), None)
    witness = next((reading for each in others if (reading := each()) is not None), None)
    if stated is None or witness is None or size_px is None:
        return stated or witness
    by_pixels_mm, by_witness_mm = (each.width_mm(*size_px) for each in (stated, witness))
    if 1.0 / _AGREEING < by_pixels_mm / by_witness_mm < _AGREEING:
        return stated
    doubt = f"{stated.source} tells a sensor {by_pixels_mm:.3g} mm wide, but {witness.source} {by_witness_mm:.3g} mm, which is taken"
    return replace(witness, doubt=doubt)


def size_as_taken_px(tags: Tags) -> tuple[int, int] | None:
    """Return width and height of the picture that the camera took, as far as it was not forgotten when the picture was made smaller.

    A reduced DNG states it as OriginalDefaultFinalSize, Exif as PixelXDimension, which many programs overwrite, and RelatedImageWidth.
    Canon's resolutions of the focal plane are fractions of thousandths of pixels and of an inch: 2272000/280 counts 2272 pixels on 7.11 mm.
    """
    if original := size_of(tags.get("Exif.Image.OriginalDefaultFinalSize", "").split()):
        return original
    stated = size_of([tags.get(f"Exif.Photo.Pixel{axis}Dimension") for axis in "XY"])
    related = size_of([tags.get(f"Exif.Iop.RelatedImage{side}") for side in ("Width", "Length")])
    told = [each for each in (stated, related) if each is not None]
    if (counted := _canons_pixels(tags)) is not None:
        zoom = _digital_zoom(tags)
        told.append((round(counted[0] / zoom), round(counted[1] / zoom)))
    return max(told, key=lambda size_px: size_px[0] * size_px[1], default=None)


def size_of(texts: Sequence[str | None]) -> tuple[int, int] | None:
    """Return width and height that two tags hold; None unless both are above 0."""
    sides = [int(number(each) or 0) for each in texts]
    return (sides[0], sides[1]) if len(sides) == 2 and min(sides) > 0 else None


def _canons_pixels(tags: Tags) -> tuple[int, int] | None:
    """Return the pixels that Canon's resolutions of the focal plane count; of a digital zoom as many as the whole sensor would have."""
    parts = [rational(tags.get(f"Exif.Photo.FocalPlane{axis}Resolution")) for axis in "XY"]
    if "canon" not in tags.get("Exif.Image.Make", "").lower():
        return None
    sides = [each[0] // _CANONS_SHARE for each in parts if each is not None and each[1] < _CANONS_SHARE * 10]
    return (sides[0], sides[1]) if len(sides) == 2 and min(sides) > 100 else None


def _digital_zoom(tags: Tags) -> float:
    """Return by how much the camera enlarged the middle of its sensor, 1 where it did not.

    Without the tag for it: Canon's pixels over the size that is stated, where that is not the size of the file, so that nobody has
    overwritten it.
    """
    stated = number(tags.get("Exif.Photo.DigitalZoomRatio"))
    if stated is not None:
        return max(stated, 1.0)
    counted, told = _canons_pixels(tags), size_of([tags.get(f"Exif.Photo.Pixel{axis}Dimension") for axis in "XY"])
    stored = size_of([tags.get("width_px"), tags.get("height_px")])
    if counted is None or told is None or stored is None or max(stored) >= max(told):
        return 1.0
    return max(1.0, max(counted) / max(told))


def sensor_of_model(
    make: str | None, model: str | None, size_px: tuple[int, int] | None, digital_zoom: float = 1.0
) -> SensorReading | None:
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
    diagonal_mm = FULL_FRAME_DIAGONAL_MM / found.crop_factor / digital_zoom
    return SensorReading(diagonal_mm / math.hypot(*size_px), size_px, f"lensfun's crop factor {found.crop_factor:.4g} of {found.model}")


@cache
def _database() -> "lensfunpy.Database | None":
    try:
        import lensfunpy
    except ImportError:
        return None
    return lensfunpy.Database()


def _is_plausible(reading: SensorReading, size_px: tuple[int, int] | None, digital_zoom: float) -> bool:
    size_px = reading.full_size_px or size_px
    return size_px is None or _PLAUSIBLE_MM[0] < reading.pitch_mm * max(size_px) * digital_zoom < _PLAUSIBLE_MM[1]


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
    def is_possible(self) -> bool:
        """Return whether there are such lenses: programs that exchange the bytes of fractions leave 2.4 mm f/0.2 behind."""
        if self.f_number is not None and self.f_number < _LEAST_F_NUMBER:
            return False
        if self.focal_length_mm is None or self.sensor is None or self.sensor.full_size_px is None:
            return True
        return self.focal_length_mm > _SHORTEST_PER_DIAGONAL * self.sensor.diagonal_mm

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
    def rough_focus_m(self) -> tuple[float, float] | None:
        """Return (nearest, farthest) that the stated focus may mean, if that is so wide that the distance places nothing; else None.

        To what the file states comes what the lens cannot tell apart: a point blurred by less than 1/1500 of the diagonal is in focus,
        which is an even interval of dioptres.
        """
        stated = self.focus_interval_m
        if stated is None or self.focus is None or self.focus_distance_m is None:
            return None
        least, most = (1.0 / each if each > 0.0 else math.inf for each in (stated[1], stated[0]))
        if self.focal_length_mm and self.f_number and self.sensor is not None and self.sensor.full_size_px is not None:
            sharp_mm = self.sensor.diagonal_mm * _SHARP_PER_DIAGONAL
            tolerance = sharp_mm * self.f_number / self.focal_length_mm**2 * MM_PER_M
            least, most = min(least, 1.0 / self.focus_distance_m - tolerance), max(most, 1.0 / self.focus_distance_m + tolerance)
        nearest_m, farthest_m = 1.0 / most if most > 0.0 else math.inf, 1.0 / least if least > 0.0 else math.inf
        return (nearest_m, farthest_m) if nearest_m < math.inf and farthest_m >= _ROUGH * nearest_m else None

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
