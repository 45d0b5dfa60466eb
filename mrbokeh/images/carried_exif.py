"""EXIF of a photograph carried on to a picture that was made of it: camera, lens, exposure, time and place; upright, of its size."""

import struct
import zlib
from pathlib import Path

from mrbokeh.images.exif import AS_STORED, exif_and_size
from mrbokeh.system.atomic_files import atomic_path

_FROM, _TO = (".jpg", ".jpeg", ".heic", ".heif", ".png", ".webp"), (".jpg", ".jpeg", ".png")
_ORIENTATION, _EXIF, _WIDTH, _HEIGHT, _MAKER_NOTE, _INTEROPERABILITY = 0x0112, 0x8769, 0xA002, 0xA003, 0x927C, 0xA005
_MOST_BYTES = 65_000
"""A segment of a JPEG holds no more."""


def carry_exif(photo: Path, out: Path, size_px: tuple[int, int]) -> None:
    """Give a JPEG or PNG of that width and height the EXIF of the photograph, if that has some.

    It leaves out maker notes, whose offsets do not survive, and the marks of another colour space.
    """
    if photo.suffix.lower() not in _FROM or out.suffix.lower() not in _TO or (found := exif_and_size(photo)) is None or not found[0]:
        return
    exif = found[0]
    details = exif.get_ifd(_EXIF)
    exif[_ORIENTATION] = AS_STORED
    details[_WIDTH], details[_HEIGHT] = size_px
    for tag in (_MAKER_NOTE, _INTEROPERABILITY):
        details.pop(tag, None)
    data = exif.tobytes()
    if len(data) > _MOST_BYTES:
        return
    stored = out.read_bytes()
    with atomic_path(out) as temporary:
        temporary.write_bytes(_png_with(stored, data) if out.suffix.lower() == ".png" else _jpeg_with(stored, data))


def _jpeg_with(stored: bytes, exif: bytes) -> bytes:
    """Return the JPEG with EXIF as its second segment, after JFIF's own where it has one."""
    start = 2 + (2 + int.from_bytes(stored[4:6], "big") if stored[2:4] == b"\xff\xe0" else 0)
    return stored[:start] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + stored[start:]


def _png_with(stored: bytes, exif: bytes) -> bytes:
    """Return the PNG with EXIF after its header (PNG 1.5, chunk eXIf)."""
    start = 8 + 12 + int.from_bytes(stored[8:12], "big")
    chunk = b"eXIf" + exif.removeprefix(b"Exif\0\0")
    return stored[:start] + struct.pack(">I", len(chunk) - 4) + chunk + struct.pack(">I", zlib.crc32(chunk)) + stored[start:]
