"""Exposure and white balance that pictures state, turned into gains.

Exposure comes from the Exif of JPEG, TIFF and PNG, or from the standard attributes of an EXR header: it says how bright the photograph
shows a given luminance, or the light of another photograph. White balance goes by colour temperature.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.compositing.plate_look.colour_match import ColourMatch, Triple, triple_of
from mrbokeh.images.color import rec709_from_XYZ
from mrbokeh.lens_measuring.matching.photo_facts import exif_tags, positive_rational
from mrbokeh.system.errors import InputError
from mrbokeh.system.typed_numbers import numbers_in

_EXPOSURE_TIME, _F_NUMBER, _ISO = 0x829A, 0x829D, 0x8827
SATURATION_CONSTANT = 1.2
"""78 / (0.65 * 100): the luminance that just fills a sensor is 1.2 * N^2 / t * 100 / ISO cd/m^2 (ISO 12232, saturation-based speed,
with the usual 0.65 of lens transmission, vignetting and angle; Lagarde and de Rousiers 2014, "Moving Frostbite to PBR", Section 5.1)."""

_OF_EXR = {"exposure_time_s": "expTime", "iso": "isoSpeed", "f_number": "aperture"}
"""Names of OpenEXR's standard attributes (OpenEXR, "Standard Optional Attributes"); times in seconds."""
COLDEST_K, WARMEST_K, BLACK_BODY_TO_K, DAYLIGHT_FROM_K = 25000.0, 2000.0, 4000.0, 5000.0


@dataclass(frozen=True)
class Exposure:
    """Exposure of a picture. gain: factor applied after it was taken (a focal stack brings its slices to one exposure)."""

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
        expected = "expected an exposure as SECONDS,ISO,F-NUMBER, such as 1/50,400,2.8"
        return cls(*map(float, numbers_in(text, expected, (3,), number=Fraction)))

    @property
    def brightness(self) -> float:
        """Proportional to the number that a given luminance gets in the picture: t * ISO / N^2."""
        return self.gain * self.exposure_time_s * self.iso / self.f_number**2

    @property
    def value_per_luminance(self) -> float:
        """The linear value (1 is full) that the camera gives 1 cd/m^2."""
        return self.brightness / (SATURATION_CONSTANT * 100.0)


def matched_exposure(plate: Exposure, reference: Exposure | None = None) -> ColourMatch:
    """Return the gain of a plate's exposure.

    reference: exposure of the photograph that the virtual light was taken from (a panorama, another slice); None: the light is in
    cd/m^2.
    """
    gain = plate.value_per_luminance if reference is None else plate.brightness / reference.brightness
    return ColourMatch((gain, gain, gain))


def exposure_of_photo(path: Path | str) -> Exposure:
    """Read the exposure from the Exif of a JPEG, TIFF or PNG. Raises InputError if a number is missing."""
    tags = exif_tags(Path(path))
    iso = tags.get(_ISO)
    known = {
        "exposure_time_s": tags.get(_EXPOSURE_TIME),
        "iso": iso[0] if isinstance(iso, tuple) and iso else iso,
        "f_number": tags.get(_F_NUMBER),
    }
    return exposure_of_metadata(known, str(path))


def exposure_of_metadata(metadata: Mapping[str, Any], where: str = "the slice") -> Exposure:
    """Return the exposure that stack.json keeps of a slice (exposure_time_s, iso, f_number, exposure_gain)."""
    found = {name: positive_rational(metadata.get(name)) for name in ("exposure_time_s", "iso", "f_number")}
    missing = [name for name, value in found.items() if value is None]
    if missing:
        raise InputError(
            f"{where}: expected its metadata to state the exposure, but {', '.join(missing)} is missing: pick a grey card instead"
        )
    return Exposure(
        **{name: value for name, value in found.items() if value is not None}, gain=positive_rational(metadata.get("exposure_gain")) or 1.0
    )


def stated_exposure(path: Path) -> Exposure:
    """Read the exposure that a picture's file states. Raises InputError if something is missing."""
    if path.suffix.lower() != ".exr":
        return exposure_of_photo(path)
    import OpenEXR

    if not path.is_file():
        raise InputError(f"expected an EXR file at {path}, but there is none: check the name")
    try:
        header = OpenEXR.File(str(path), header_only=True).header()
    except (RuntimeError, OSError, ValueError) as error:
        raise InputError(f"{path} cannot be read as EXR: {error}") from None
    return exposure_of_metadata({name: header.get(attribute) for name, attribute in _OF_EXR.items()}, str(path))


def white_of_kelvin(kelvin: float) -> Triple:
    """Return the linear Rec.709 of a light of that temperature, green being 1.

    The light is a black body up to 4000 K, daylight (CIE D) from 5000 K on, and a mixture between. 6504 K is (1, 1, 1), the white of
    Rec.709. Raises InputError outside 2000 to 25000 K.
    """
    if not WARMEST_K <= kelvin <= COLDEST_K:
        raise InputError(f"expected a colour temperature of {WARMEST_K:g} to {COLDEST_K:g} K, got {kelvin:g}")
    of_daylight = float(np.clip((kelvin - BLACK_BODY_TO_K) / (DAYLIGHT_FROM_K - BLACK_BODY_TO_K), 0.0, 1.0))
    daylight, black_body = (
        np.array(each(max(kelvin, least_k))) for each, least_k in ((_daylight_xy, BLACK_BODY_TO_K), (_black_body_xy, 0.0))
    )
    x, y = of_daylight * daylight + (1.0 - of_daylight) * black_body
    rgb = rec709_from_XYZ @ np.array([x / y, 1.0, (1.0 - x - y) / y])
    return triple_of(rgb / rgb[1])


def white_balance_gain(plate_k: float, reference_k: float = 6504.0) -> Triple:
    """Gain per channel for light balanced for reference_k that shall look balanced for plate_k (von Kries in linear Rec.709).

    A camera set to tungsten shows daylight bluish: red below 1, blue above.
    """
    reference, plate = white_of_kelvin(reference_k), white_of_kelvin(plate_k)
    return triple_of(np.array(reference) / np.array(plate))


def _daylight_xy(kelvin: float) -> tuple[float, float]:
    """CIE 15, equations 3.3 and 3.4."""
    t = 1e3 / kelvin
    x = 0.244063 + t * (0.09911 + t * (2.9678 - 4.6070 * t)) if kelvin <= 7000.0 else 0.237040 + t * (0.24748 + t * (1.9018 - 2.0064 * t))
    return x, -3.0 * x * x + 2.870 * x - 0.275


def _black_body_xy(kelvin: float) -> tuple[float, float]:
    """The cubic of Kim et al. (US patent 7024034, 2006) for 1667 to 25000 K."""
    t = 1e3 / kelvin
    x = (
        0.179910 + t * (0.8776956 + t * (-0.2343589 - 0.2661239 * t))
        if kelvin <= 4000.0
        else 0.240390 + t * (0.2226347 + t * (2.1070379 - 3.0258469 * t))
    )
    if kelvin <= 2222.0:
        return x, -0.20219683 + x * (2.18555832 + x * (-1.34811020 - 1.1063814 * x))
    if kelvin <= 4000.0:
        return x, -0.16748867 + x * (2.09137015 + x * (-1.37418593 - 0.9549476 * x))
    return x, -0.37001483 + x * (3.75112997 + x * (-5.87338670 + 3.0817580 * x))
