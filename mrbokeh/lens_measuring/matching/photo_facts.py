"""Facts that a photograph's metadata state about its lens: Exif of JPEG, TIFF, PNG, WebP and HEIC."""

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.images.exif import cut_from_px, exif_and_size
from mrbokeh.optics.lens import lens_distance_m
from mrbokeh.system.console import flag
from mrbokeh.system.errors import InputError

_EXIF_IFD = 0x8769
_F_NUMBER, _SUBJECT_DISTANCE, _FOCAL_LENGTH, _FOCAL_LENGTH_35MM = 0x829D, 0x9206, 0x920A, 0xA405
_PIXEL_WIDTH, _PIXEL_HEIGHT, _PLANE_RESOLUTION, _PLANE_UNIT = 0xA002, 0xA003, 0xA20E, 0xA210
_MM_PER_UNIT = {2: 25.4, 3: 10.0, 4: 1.0}
_FULL_FRAME_DIAGONAL_MM = float(np.hypot(36.0, 24.0))
_INFINITELY_FAR = 0xFFFFFFFF
_PLAUSIBLE_MM = (3.0, 60.0)
"""Width of sensors; a picture made smaller counts too few pixels on too little of them."""


@dataclass(frozen=True)
class PhotoFacts:
    """Facts about the lens of a photograph; None if unknown. focus_distance_m: from the lens; inf is allowed."""

    focal_length_mm: float | None = None
    f_number: float | None = None
    sensor_width_mm: float | None = None
    focus_distance_m: float | None = None

    def given(self, **values: float | None) -> "PhotoFacts":
        """Return the facts with what the user states in place of what the file does."""
        for name, value in values.items():
            if value is not None and not value > 0.0:
                raise InputError(f"expected {flag(name)} above 0, got {value:g}")
        return PhotoFacts(
            **{each.name: getattr(self, each.name) if values.get(each.name) is None else values[each.name] for each in fields(self)}
        )

    def require(self, where: Path | str) -> None:
        """Require everything but the focus distance."""
        names = ("focal_length_mm", "f_number", "sensor_width_mm")
        missing = [flag(name) for name in names if getattr(self, name) is None]
        if missing:
            raise InputError(f"{where}: its metadata do not tell all that a lens needs: give {', '.join(missing)}")


def read_facts(path: Path | str, size_px: tuple[int, int]) -> PhotoFacts:
    """Read the facts of a photograph; a file without Exif gives PhotoFacts without values. size_px: (width, height).

    The sensor's width comes from the pixels per length on it, else from the focal length for 35 mm film, which counts diagonals (CIPA
    DCG-001). Exif counts the subject's distance from the film plane; with T that distance, the thin lens stands s from the subject with
    s + s f / (s - f) = T.
    """
    tags = exif_tags(Path(path))
    focal_length_mm = positive_rational(tags.get(_FOCAL_LENGTH))
    distance_m = positive_rational(tags.get(_SUBJECT_DISTANCE))
    if distance_m is not None and focal_length_mm is not None:
        distance_m = lens_distance_m(distance_m, focal_length_mm)
    return PhotoFacts(focal_length_mm, positive_rational(tags.get(_F_NUMBER)), _sensor_width_mm(tags, focal_length_mm, size_px), distance_m)


def exif_tags(path: Path) -> dict[int, Any]:
    found = exif_and_size(path)
    return {} if found is None else dict(found[0].get_ifd(_EXIF_IFD))


def positive_rational(value: Any) -> float | None:
    """Return a rational number of Exif; 0 and 0/0 mean unknown, a numerator of all ones infinitely far."""
    if getattr(value, "numerator", None) == _INFINITELY_FAR:
        return float("inf")
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError):
        return None
    return number if np.isfinite(number) and number > 0.0 else None


def _pixels(value: Any) -> int:
    number = positive_rational(value)
    return 0 if number is None or np.isinf(number) else int(number)


def _sensor_width_mm(tags: dict[int, Any], focal_length_mm: float | None, size_px: tuple[int, int]) -> float | None:
    resolution, unit = positive_rational(tags.get(_PLANE_RESOLUTION)), _MM_PER_UNIT.get(tags.get(_PLANE_UNIT, 2))
    stated_px = _pixels(tags.get(_PIXEL_WIDTH)), _pixels(tags.get(_PIXEL_HEIGHT))
    cut_px = cut_from_px(size_px, stated_px)
    pixels = float(size_px[0] if cut_px else stated_px[0] or size_px[0])
    if resolution is not None and unit is not None and _PLAUSIBLE_MM[0] < pixels / resolution * unit < _PLAUSIBLE_MM[1]:
        return pixels / resolution * unit
    film_mm = positive_rational(tags.get(_FOCAL_LENGTH_35MM))
    if film_mm is None or focal_length_mm is None:
        return None
    return _FULL_FRAME_DIAGONAL_MM * focal_length_mm / film_mm * size_px[0] / float(np.hypot(*(cut_px or size_px)))
