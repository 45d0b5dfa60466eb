"""What the stated exposure says about brightness: how bright the photograph shows a given luminance, or the light of another photograph."""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

from mrbokeh.compositing.plate_look.colour_match import ColourMatch
from mrbokeh.lens_measuring.matching.photo_facts import exif_tags, positive_rational
from mrbokeh.system.errors import InputError

_EXPOSURE_TIME, _F_NUMBER, _ISO = 0x829A, 0x829D, 0x8827
SATURATION_CONSTANT = 1.2
"""78 / (0.65 * 100): the luminance that just fills a sensor is 1.2 * N^2 / t * 100 / ISO cd/m^2 (ISO 12232, saturation-based speed,
with the usual 0.65 of lens transmission, vignetting and angle; Lagarde and de Rousiers 2014, "Moving Frostbite to PBR", Section 5.1)."""


@dataclass(frozen=True)
class Exposure:
    """gain: by what the picture was multiplied after it was taken (a focal stack brings its slices to one exposure)."""

    exposure_time_s: float
    iso: float
    f_number: float
    gain: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not (0.0 < value < float("inf")):
                raise InputError(f"expected {name} of an exposure above 0, got {value:g}")

    @classmethod
    def parse(cls, text: str) -> "Exposure":
        """ "SECONDS,ISO,F-NUMBER" as a user types it; seconds may be a fraction. Raises InputError."""
        try:
            time_s, iso, f_number = (float(Fraction(part.strip())) for part in text.split(","))
        except (ValueError, ZeroDivisionError):
            raise InputError(f"expected an exposure as SECONDS,ISO,F-NUMBER, such as 1/50,400,2.8, got {text!r}") from None
        return cls(time_s, iso, f_number)

    @property
    def brightness(self) -> float:
        """Proportional to the number that a given luminance gets in the picture: t * ISO / N^2."""
        return self.gain * self.exposure_time_s * self.iso / self.f_number**2

    @property
    def value_per_luminance(self) -> float:
        """The linear value (1 is full) that the camera gives 1 cd/m^2."""
        return self.brightness / (SATURATION_CONSTANT * 100.0)


def matched_exposure(plate: Exposure, reference: Exposure | None = None) -> ColourMatch:
    """reference: of the photograph that the virtual light was taken from (a panorama, another slice); None: the light is in cd/m^2."""
    gain = plate.value_per_luminance if reference is None else plate.brightness / reference.brightness
    return ColourMatch((gain, gain, gain))


def exposure_of_photo(path: Path | str, f_number: float | None = None) -> Exposure:
    """From the Exif of a JPEG, TIFF or PNG. f_number: for manual lenses, that state none. Raises InputError where something is missing."""
    tags = exif_tags(Path(path))
    iso = tags.get(_ISO)
    known = {
        "exposure_time_s": tags.get(_EXPOSURE_TIME),
        "iso": iso[0] if isinstance(iso, tuple) and iso else iso,
        "f_number": f_number or tags.get(_F_NUMBER),
    }
    return exposure_of_metadata(known, str(path))


def exposure_of_metadata(metadata: Mapping[str, Any], where: str = "the slice", f_number: float | None = None) -> Exposure:
    """From what stack.json keeps of a slice (exposure_time_s, iso, f_number, exposure_gain)."""
    stated = {**metadata, "f_number": f_number or metadata.get("f_number")}
    found = {name: positive_rational(stated.get(name)) for name in ("exposure_time_s", "iso", "f_number")}
    missing = [name for name, value in found.items() if value is None]
    if missing:
        raise InputError(
            f"{where}: expected its metadata to state the exposure, but {', '.join(missing)} is missing: pick a grey card instead"
        )
    return Exposure(
        **{name: value for name, value in found.items() if value is not None}, gain=positive_rational(metadata.get("exposure_gain")) or 1.0
    )
