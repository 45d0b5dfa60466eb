"""Shooting data of photographs: through pyexiv2, then exiftool and exifread for what is still open; and files cut short in copying.

exifread is pure Python and always there; where pyexiv2 is not, or cannot open a file, it comes first. exiftool, which reads more maker
notes than any library and is used where it is on PATH, misstates the sensor of pictures that were made smaller or turned.
"""

import json
import logging
import math
import shutil
import subprocess
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

from capture.photos.focus_metadata import (
    UINT16_MAX,
    FocusReading,
    Tags,
    at_infinity,
    canon_reading,
    is_whole_canon_note,
    number,
    read_focus,
)
from capture.photos.photo_metadata import (
    PhotoMetadata,
    SensorReading,
    parse_time,
    read_sensor,
    sensor_of_model,
    size_as_taken_px,
    size_of,
)
from mrbokeh.images.heif import is_heif
from mrbokeh.system.errors import InputError, require_file

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
        camera_model=_text_of(found, "Model"),
        lens_model=_text_of(found, "LensModel"),
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


def _text_of(found: dict[str, Any], name: str) -> str | None:
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
        return sensor_of_model(_text_of(found, "Make"), _text_of(found, "Model"), (int(width_px), int(height_px)))
    return SensorReading(width_mm / width_px, (int(width_px), int(height_px)), "exiftool FocalPlaneXSize")


def _as_exiv2(values: Any) -> str:
    """Return values as exiv2 prints them: fractions as n/d, several with spaces between them."""
    if isinstance(values, str):
        return values
    plain = [each[0] if isinstance(each, tuple) else each for each in values]  # floating point comes as tuples of one
    parts = [f"{each.num}/{each.den}" if hasattr(each, "den") else str(each) for each in plain]
    return " ".join(parts)


_NO_MESSAGES = 4
_READ_WHOLE = ("image/png", "image/jpeg")
_BLOCKS = (("TileOffsets", "TileByteCounts"), ("StripOffsets", "StripByteCounts"))


def read_metadata(path: Path) -> PhotoMetadata:
    """Return the shooting data of a photograph; all None where the file has none or cannot be read."""
    return read_metadata_of([path])[0]


def read_metadata_of(paths: Sequence[Path], advance: Callable[[], None] = lambda: None) -> list[PhotoMetadata]:
    """Return the shooting data of photographs; `advance` is called after each."""
    found, states_any = [], []
    for path in paths:
        tags = read_tags(path) or read_tags_with_exifread(path)
        found.append(metadata_from_tags(tags))
        # A PNG or JPEG in which exiv2 finds nothing at all is not worth the start of exiftool.
        states_any.append(tags.get("mime_type") not in _READ_WHOLE or any(name.startswith(("Exif.", "Xmp.")) for name in tags))
        advance()
    gaps = [index for index, metadata in enumerate(found) if _has_gaps(metadata)]
    asked = [index for index in gaps if states_any[index]]
    for index, more in zip(asked, read_with_exiftool([paths[index] for index in asked]), strict=True):
        found[index] = found[index].filled_from(more)
    for index in gaps:
        if _has_gaps(found[index]):
            found[index] = found[index].filled_from(metadata_from_tags(read_tags_with_exifread(paths[index])))
    # HEIC is decoded upright (irot, imir); its Exif tells the same turn again.
    turned = [replace(each, orientation=None) if is_heif(path) else each for path, each in zip(paths, found, strict=True)]
    return [each if each.is_possible else replace(each, focal_length_mm=None, f_number=None) for each in turned]


def read_tags(path: Path) -> dict[str, str]:
    """Return EXIF, maker note and XMP tags by exiv2's names, with "mime_type", "width_px" and "height_px"; empty if unreadable."""
    try:
        import pyexiv2
    except ImportError:
        return {}
    pyexiv2.set_log_level(_NO_MESSAGES)
    try:
        with pyexiv2.Image(str(path)) as image:
            exif, xmp = image.read_exif("ISO-8859-1"), image.read_xmp("ISO-8859-1")
            size = {"width_px": str(image.get_pixel_width()), "height_px": str(image.get_pixel_height())}
            texts = {key: value for key, value in (exif | xmp).items() if isinstance(value, str)}
            return texts | size | {"mime_type": image.get_mime_type()}
    except (RuntimeError, UnicodeError):
        return {}


def metadata_from_tags(tags: Tags) -> PhotoMetadata:
    """Return shooting data from exiv2's tags."""
    focal_length_mm = _focal_length_mm(tags)
    size_px = size_of([tags.get("width_px"), tags.get("height_px")])
    sensor, orientation = read_sensor(tags, focal_length_mm, size_px), number(tags.get("Exif.Image.Orientation"))
    return PhotoMetadata(
        focal_length_mm=focal_length_mm,
        f_number=_f_number(tags),
        exposure_time_s=_first_positive(tags, "Exif.Photo.ExposureTime", "Exif.Image.ExposureTime")
        or _from_apex(tags, "Exif.Photo.ShutterSpeedValue", -1.0),
        iso=_iso(tags),
        taken_at=_taken_at(tags),
        camera_model=_text(tags, "Exif.Image.Model", "Exif.Image.UniqueCameraModel"),
        lens_model=_text(tags, "Exif.Photo.LensModel", "Exif.Canon.LensModel", "Xmp.aux.Lens"),
        focus=read_focus(tags),
        sensor=sensor,
        orientation=int(orientation) if orientation else None,
        taken_size_px=size_as_taken_px(tags),
    )


def require_whole_tiff(path: Path) -> None:
    """Raise InputError if a TIFF-like file (DNG and most RAW) speaks of pixels that lie behind its end.

    Decoders notice most files cut short, but lossy tiles of a DNG can go missing without a word.
    """
    require_file(path, "a photograph")
    size, tags = path.stat().st_size, read_tags(path)
    for offsets_name, counts_name in _BLOCKS:
        for key, offsets in tags.items():
            group, _, name = key.rpartition(".")
            if name == offsets_name and (end := _end(offsets, tags.get(f"{group}.{counts_name}", ""))) > size:
                raise InputError(f"{path} is cut short: it has {size} bytes, its pixels reach to {end}. Copy it again")


def _has_gaps(metadata: PhotoMetadata) -> bool:
    return None in (metadata.focal_length_mm, metadata.f_number, metadata.focus, metadata.exposure_time_s)


def _first_positive(tags: Tags, *names: str) -> float | None:
    values = (number(tags.get(name)) for name in names)
    return next((value for value in values if value is not None and value > 0), None)


def _from_apex(tags: Tags, name: str, power: float) -> float | None:
    """Convert an APEX value, which is a logarithm: f-number = 2^(Av / 2), exposure time = 2^-Tv."""
    value = number(tags.get(name))
    return None if value is None else 2.0 ** (value * power)


def _f_number(tags: Tags) -> float | None:
    return _first_positive(tags, "Exif.Photo.FNumber", "Exif.Image.FNumber") or _from_apex(tags, "Exif.Photo.ApertureValue", 0.5)


def _focal_length_mm(tags: Tags) -> float | None:
    """Read EXIF; else Canon's maker note, which counts in units that CanonCs.Lens (longest, shortest, units per mm) explains."""
    stated = _first_positive(tags, "Exif.Photo.FocalLength", "Exif.Image.FocalLength")
    canon, lens = tags.get("Exif.Canon.FocalLength", "").split(), tags.get("Exif.CanonCs.Lens", "").split()
    if stated or len(canon) < 2 or len(lens) != 3:
        return stated
    length, per_mm = number(canon[1]), number(lens[2])
    return length / per_mm if length and per_mm else None


def _iso(tags: Tags) -> float | None:
    """Read EXIF; else Nikon's maker note "0 400"; else Canon's base speed and gain, as 32nds of a stop."""
    nikon = tags.get("Exif.Nikon3.ISOSpeed", "").split() or [""]
    return _first_positive(tags, "Exif.Photo.ISOSpeedRatings", "Exif.Image.ISOSpeedRatings") or number(nikon[-1]) or _canons_iso(tags)


_MOST_STOPS = 24


def _canons_iso(tags: Tags) -> float | None:
    base = number(tags.get("Exif.CanonSi.ISOSpeed"))
    if not base or not is_whole_canon_note(tags):
        return None
    gain = number(tags.get("Exif.CanonSi.AutoISO")) or 0.0
    signed = gain - (UINT16_MAX + 1) * (gain > UINT16_MAX // 2)
    steps = (base + signed) / 32.0
    return 100.0 / 32.0 * 2.0**steps if abs(steps) < _MOST_STOPS else None


def _taken_at(tags: Tags) -> datetime | None:
    for name in ("Exif.Photo.DateTimeOriginal", "Exif.Image.DateTimeOriginal", "Exif.Image.DateTime"):
        moment = parse_time(tags.get(name))
        if moment is not None:
            return moment.replace(microsecond=_microseconds(tags.get("Exif.Photo.SubSecTimeOriginal")))
    return None


def _microseconds(digits: str | None) -> int:
    digits = (digits or "").strip()
    return int(digits[:6].ljust(6, "0")) if digits.isdecimal() else 0


def _text(tags: Mapping[str, str], *names: str) -> str | None:
    return next((tags[name].strip() for name in names if tags.get(name, "").strip()), None)


def _end(offsets: str, counts: str) -> int:
    try:
        return max((int(offset) + int(count) for offset, count in zip(offsets.split(), counts.split(), strict=True)), default=0)
    except ValueError:
        return 0
