"""Sensor sizes by camera model from lensfun's database (CC-BY-SA 3.0, in the lensfunpy wheel), for cameras whose files do not tell."""

import math
from functools import cache
from typing import TYPE_CHECKING

from capture.photos.sensor_reading import SensorReading

if TYPE_CHECKING:
    import lensfunpy

FULL_FRAME_DIAGONAL_MM = math.hypot(36.0, 24.0)


def sensor_of_model(make: str | None, model: str | None, size_px: tuple[int, int] | None) -> SensorReading | None:
    """The sensor of a camera whose full pictures have size_px (width, height); None where lensfun is not installed or knows it not.

    The crop factor compares diagonals, rounded to about 0.5 % (Nikon D3300: 23.64 mm by it, 23.5 by the data sheet).
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
