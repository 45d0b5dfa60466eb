"""PhotoMetadata: how one photograph was taken."""

from dataclasses import dataclass, fields, replace
from datetime import datetime

from capture.photos.focus_metadata import FocusReading
from capture.photos.sensor_metadata import SensorReading


@dataclass(frozen=True)
class PhotoMetadata:
    """The shooting data of one photograph; None is unknown. orientation: the EXIF tag (1 is upright), which nobody applies here."""

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

    def filled_from(self, other: "PhotoMetadata") -> "PhotoMetadata":
        """What is unknown here, taken from another source."""
        gaps = {each.name: getattr(other, each.name) for each in fields(self) if getattr(self, each.name) is None}
        return replace(self, **gaps)

    @property
    def relative_exposure(self) -> float | None:
        """Exposure time x ISO / f-number squared: proportional to the signal of a scene, so far as the camera keeps its word."""
        if not self.exposure_time_s or not self.iso or not self.f_number:
            return None
        return self.exposure_time_s * self.iso / self.f_number**2

    @property
    def focus_distance_m(self) -> float | None:
        """From the lens, or None."""
        return None if self.focus is None else self.focus.lens_distance_m(self.focal_length_mm)


def parse_time(text: str | None) -> datetime | None:
    """EXIF's "2024:05:31 12:00:00"; None for "0000:00:00 00:00:00" and the like."""
    try:
        return datetime.strptime((text or "").strip()[:19], "%Y:%m:%d %H:%M:%S")
    except ValueError:
        return None
