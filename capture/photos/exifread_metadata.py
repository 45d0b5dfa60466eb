"""EXIF through exifread, pure Python: for files and machines on which exiv2 and exiftool say nothing."""

import logging
from pathlib import Path
from typing import Any

# exifread's names of groups and tags to exiv2's; maker notes differ too much between the two and are left out.
_GROUPS = {"EXIF": "Exif.Photo", "Image": "Exif.Image"}
_TAGS = {"ExifImageWidth": "PixelXDimension", "ExifImageLength": "PixelYDimension"}


def read_tags_with_exifread(path: Path) -> dict[str, str]:
    """EXIF tags by exiv2's names; empty where exifread is not installed or cannot read the file."""
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
            tags[f"{_GROUPS[group]}.{_TAGS.get(name, name)}"] = _text(value.values)
    return tags


def _text(values: Any) -> str:
    """As exiv2 prints values: fractions as n/d, several with spaces between them."""
    if isinstance(values, str):
        return values
    parts = [f"{each.num}/{each.den}" if hasattr(each, "den") else str(each) for each in values]
    return " ".join(parts)
