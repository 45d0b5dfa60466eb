"""The tags in the header of a TIFF, whatever its pixels are."""

import struct
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

TIFF_SUFFIXES = (".tif", ".tiff")
_HEADER_BYTES, _BIG_HEADER_BYTES, _BIG = 8, 16, 43


def tiff_tags(path: Path) -> Mapping[int, Any]:
    """By their numbers, of the first picture; none where the file is no TIFF or its header is damaged."""
    from PIL.TiffImagePlugin import ImageFileDirectory_v2

    try:
        with path.open("rb") as file, warnings.catch_warnings(action="ignore"):
            header = file.read(_HEADER_BYTES)
            header += file.read(_BIG_HEADER_BYTES - _HEADER_BYTES) if header[2:3] == bytes([_BIG]) else b""
            tags = ImageFileDirectory_v2(header)
            file.seek(tags.next)
            tags.load(file)
            return dict(tags)
    except (OSError, SyntaxError, ValueError, EOFError, struct.error):
        return {}
