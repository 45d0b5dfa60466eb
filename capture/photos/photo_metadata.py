"""Shooting data of one photograph."""

from dataclasses import dataclass, fields, replace
from datetime import datetime

from capture.photos.focus_metadata import FocusReading
from capture.photos.sensor_metadata import SensorReading


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
