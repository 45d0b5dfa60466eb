"""Shooting data through exiftool, a program of its own that reads more maker notes than any library; used where it is on PATH."""

import json
import math
import shutil
import subprocess
from pathlib import Path
from typing import Any

from capture.photos.focus_metadata import FocusReading, canon_reading
from capture.photos.photo_metadata import PhotoMetadata, parse_time
from capture.photos.sensor_metadata import SensorReading

_TAGS = (
    "FocalLength", "FNumber", "ExposureTime", "ISO", "DateTimeOriginal", "Make", "Model", "LensModel", "Orientation", "ImageWidth",
    "ImageHeight", "FocalPlaneXSize", "SubjectDistance", "FocusDistance", "FocusDistanceLower", "FocusDistanceUpper",
    "ApproximateFocusDistance",
)  # fmt: skip
_TIMEOUT_S = 60
_INFINITE_M = 0xFFFFFFFF


def read_with_exiftool(path: Path) -> PhotoMetadata:
    """The shooting data that exiftool finds; all None where it is not installed or fails."""
    program = shutil.which("exiftool")
    if program is None:
        return PhotoMetadata()
    command = [program, "-n", "-j", *(f"-{tag}" for tag in _TAGS), str(path)]
    try:
        answer = subprocess.run(command, capture_output=True, timeout=_TIMEOUT_S, check=True)
        return metadata_from_exiftool(json.loads(answer.stdout)[0])
    except (OSError, subprocess.SubprocessError, ValueError, IndexError):
        return PhotoMetadata()


def metadata_from_exiftool(found: dict[str, Any]) -> PhotoMetadata:
    """Shooting data from one object of `exiftool -n -j`."""
    orientation = _positive(found, "Orientation")
    return PhotoMetadata(
        focal_length_mm=_positive(found, "FocalLength"),
        f_number=_positive(found, "FNumber"),
        exposure_time_s=_positive(found, "ExposureTime"),
        iso=_positive(found, "ISO"),
        taken_at=parse_time(str(found.get("DateTimeOriginal", ""))),
        camera_model=found.get("Model") and str(found["Model"]),
        lens_model=found.get("LensModel") and str(found["LensModel"]),
        focus=_focus(found),
        sensor=_sensor(found),
        orientation=None if orientation is None else int(orientation),
    )


def _positive(found: dict[str, Any], name: str) -> float | None:
    value = found.get(name)
    return float(value) if isinstance(value, (int, float)) and value > 0 else None


def _focus(found: dict[str, Any]) -> FocusReading | None:
    """Canon's interval, EXIF, then the maker's distance. exiftool gives metres; Olympus' 0 means infinity, others' unknown."""
    nearest_m, farthest_m = _positive(found, "FocusDistanceLower") or 0.0, _positive(found, "FocusDistanceUpper") or 0.0
    if nearest_m > 0.0 and farthest_m > 0.0:
        return canon_reading(nearest_m, farthest_m, f"exiftool FocusDistanceLower, Upper = {nearest_m}, {farthest_m} m")
    for name in ("SubjectDistance", "FocusDistance", "ApproximateFocusDistance"):
        distance_m = _positive(found, name)
        if name == "FocusDistance" and found.get(name) == 0 and str(found.get("Make", "")).upper().startswith(("OLYMPUS", "OM ")):
            distance_m = math.inf
        if distance_m is not None:
            distance_m = math.inf if distance_m >= _INFINITE_M else distance_m
            return FocusReading(distance_m, distance_m, distance_m, "film_plane", f"exiftool {name} = {found[name]} m")
    return None


def _sensor(found: dict[str, Any]) -> SensorReading | None:
    """FocalPlaneXSize is in millimetres."""
    width_mm, width_px, height_px = (_positive(found, name) for name in ("FocalPlaneXSize", "ImageWidth", "ImageHeight"))
    if not width_mm or not width_px or not height_px:
        return None
    return SensorReading(width_mm / width_px, (int(width_px), int(height_px)), "exiftool FocalPlaneXSize")
