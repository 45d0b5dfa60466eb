"""Shooting data through exiftool, which reads more maker notes than any library, and exifread, pure Python.

For files and machines on which exiv2 says too little: exiftool is used where it is on PATH.
"""

import json
import logging
import math
import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from capture.photos.focus_metadata import FocusReading, at_infinity, canon_reading
from capture.photos.photo_metadata import PhotoMetadata, parse_time
from capture.photos.sensor_metadata import SensorReading, sensor_of_model

_TAGS = (
    "FocalLength", "FNumber", "ExposureTime", "ISO", "DateTimeOriginal", "Make", "Model", "LensModel", "Orientation", "ImageWidth",
    "ImageHeight", "FocalPlaneXSize", "SubjectDistance", "FocusDistance", "FocusDistanceLower", "FocusDistanceUpper",
    "ApproximateFocusDistance", "LensPositionAbsolute",
)  # fmt: skip
_TIMEOUT_S = 120
_FILES_AT_ONCE = 100
_INFINITE_M = 0xFFFFFFFF
_CODE_TOLERANCE = 1e-3
# exifread's names of groups and tags to exiv2's; maker notes differ too much between the two and are left out.
_GROUPS = {"EXIF": "Exif.Photo", "Image": "Exif.Image"}
_RENAMED = {"ExifImageWidth": "PixelXDimension", "ExifImageLength": "PixelYDimension"}


def read_with_exiftool(paths: Sequence[Path]) -> list[PhotoMetadata]:
    """Return the shooting data that exiftool finds, for each file; all None where it is not installed or fails.

    Many files in one call: starting the program takes ten times as long as reading a file.
    """
    program = shutil.which("exiftool")
    if program is None:
        return [PhotoMetadata()] * len(paths)
    found: dict[str, dict[str, Any]] = {}
    for first in range(0, len(paths), _FILES_AT_ONCE):
        found |= _answers(program, [str(path) for path in paths[first : first + _FILES_AT_ONCE]])
    return [metadata_from_exiftool(found.get(Path(path).as_posix(), {})) for path in paths]


def metadata_from_exiftool(found: dict[str, Any]) -> PhotoMetadata:
    """Return shooting data from one object of `exiftool -n -j`."""
    orientation = _positive(found, "Orientation")
    return PhotoMetadata(
        focal_length_mm=_positive(found, "FocalLength"),
        f_number=_positive(found, "FNumber"),
        exposure_time_s=_positive(found, "ExposureTime"),
        iso=_positive(found, "ISO"),
        taken_at=parse_time(str(found.get("DateTimeOriginal", ""))),
        camera_model=_text(found, "Model"),
        lens_model=_text(found, "LensModel"),
        focus=_focus(found),
        sensor=_sensor(found),
        orientation=None if orientation is None else int(orientation),
        lens_position=_lens_position(found),
    )


def read_tags_with_exifread(path: Path) -> dict[str, str]:
    """Return EXIF tags by exiv2's names; empty where exifread is not installed or cannot read the file."""
    try:
        import exifread
    except ImportError:
        return {}
    logging.getLogger("exifread").setLevel(logging.CRITICAL)
    try:
        with open(path, "rb") as file:
            found = exifread.process_file(file, details=False)
    except Exception:  # a parser of foreign bytes may stumble in any way; what it cannot read is unknown
        return {}
    tags = {}
    for key, value in found.items():
        group, _, name = key.partition(" ")
        if group in _GROUPS and " " not in name and hasattr(value, "values"):
            tags[f"{_GROUPS[group]}.{_RENAMED.get(name, name)}"] = _as_exiv2(value.values)
    return tags


def _answers(program: str, files: list[str]) -> dict[str, dict[str, Any]]:
    """Return tags by file name, with / between folders as exiftool prints them; it answers for the others where one cannot be read."""
    command = [program, "-n", "-j", *(f"-{tag}" for tag in _TAGS), *files]
    try:
        answer = subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S)
        return {each["SourceFile"]: each for each in json.loads(answer.stdout)}
    except (OSError, subprocess.SubprocessError, ValueError, KeyError, TypeError):
        return {}


def _text(found: dict[str, Any], name: str) -> str | None:
    """Return text, also where JSON made a number of a name that looks like one (model "96650")."""
    return str(found[name]) if found.get(name) else None


def _positive(found: dict[str, Any], name: str) -> float | None:
    value = found.get(name)
    return float(value) if isinstance(value, (int, float)) and value > 0 else None


def _lens_position(found: dict[str, Any]) -> int | None:
    value = found.get("LensPositionAbsolute")
    return value if isinstance(value, int) and not isinstance(value, bool) else None


def _focus(found: dict[str, Any]) -> FocusReading | None:
    """Read Canon's interval, EXIF, then the maker's distance in metres. Olympus' 0 is infinity, others' unknown.

    Nikon's Z lenses stand at infinity where LensPositionAbsolute is 0 or less: a measured place of the drive, no sentinel.
    """
    nearest_m, farthest_m = _positive(found, "FocusDistanceLower") or 0.0, _positive(found, "FocusDistanceUpper") or 0.0
    if nearest_m > 0.0 and farthest_m > 0.0:
        return canon_reading(nearest_m, farthest_m, f"exiftool FocusDistanceLower, Upper = {nearest_m}, {farthest_m} m")
    make, position = str(found.get("Make", "")).upper(), _lens_position(found)
    if make.startswith("NIKON") and position is not None and position <= 0:
        return FocusReading.from_film_plane(math.inf, math.inf, math.inf, f"exiftool LensPositionAbsolute = {position}")
    for name in ("SubjectDistance", "FocusDistance", "ApproximateFocusDistance"):
        distance_m = _positive(found, name)
        if name == "FocusDistance" and found.get(name) == 0 and make.startswith(("OLYMPUS", "OM ")):
            distance_m = math.inf
        if distance_m is not None:
            return _of_distance(distance_m, name, make, f"exiftool {name} = {found[name]} m")
    return None


def _of_distance(distance_m: float, name: str, make: str, source: str) -> FocusReading:
    """Return a reading with the interval of Nikon's code, which exiftool has decoded: steps of 10^(1/40), or 2^(1/3072) with Z lenses."""
    if distance_m >= _INFINITE_M:
        return at_infinity(source)
    code = 40.0 * math.log10(distance_m / 0.01)
    coarse = name == "FocusDistance" and make.startswith("NIKON") and abs(code - round(code)) < _CODE_TOLERANCE
    half_step = 10.0 ** (0.5 / 40.0) if coarse else 1.0
    return FocusReading.from_film_plane(distance_m, distance_m / half_step, distance_m * half_step, source)


def _sensor(found: dict[str, Any]) -> SensorReading | None:
    """Read FocalPlaneXSize, which is in millimetres; without it the model tells."""
    width_mm, width_px, height_px = (_positive(found, name) for name in ("FocalPlaneXSize", "ImageWidth", "ImageHeight"))
    if not width_px or not height_px:
        return None
    if not width_mm:
        return sensor_of_model(_text(found, "Make"), _text(found, "Model"), (int(width_px), int(height_px)))
    return SensorReading(width_mm / width_px, (int(width_px), int(height_px)), "exiftool FocalPlaneXSize")


def _as_exiv2(values: Any) -> str:
    """Return values as exiv2 prints them: fractions as n/d, several with spaces between them."""
    if isinstance(values, str):
        return values
    parts = [f"{each.num}/{each.den}" if hasattr(each, "den") else str(each) for each in values]
    return " ".join(parts)
