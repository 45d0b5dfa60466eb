"""TIFF of one picture with 16 bits a channel and any tags: little-endian, one strip, not compressed, which takes a tenth of LZW's time."""

import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import UInt16

from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError

BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL = 1, 2, 3, 4, 5, 7, 10
_CODES = {BYTE: "B", ASCII: "B", SHORT: "H", LONG: "I", RATIONAL: "I", UNDEFINED: "B", SRATIONAL: "i"}
_PARTS = {RATIONAL: 2, SRATIONAL: 2}
_HEADER_BYTES, _ENTRY_BYTES, _INLINE_BYTES = 8, 12, 4
_LARGEST_BYTES = 2**32 - 2**20


@dataclass(frozen=True)
class TiffTag:
    """kind: one of the types of TIFF 6.0. values: whole numbers; of fractions numerators and denominators in turn."""

    kind: int
    values: tuple[int, ...]

    def packed(self) -> tuple[int, bytes]:
        """(count, bytes) as the directory has them."""
        return len(self.values) // _PARTS.get(self.kind, 1), struct.pack(f"<{len(self.values)}{_CODES[self.kind]}", *self.values)


def text_tag(text: str) -> TiffTag:
    return TiffTag(ASCII, (*text.encode("ascii", "replace"), 0))


def fractions_tag(values: Sequence[float], denominator: int, kind: int = SRATIONAL) -> TiffTag:
    return TiffTag(kind, tuple(each for value in values for each in (round(value * denominator), denominator)))


def write_tiff(path: Path, pixels: UInt16[np.ndarray, "height width 3"], tags: Mapping[int, TiffTag]) -> None:
    """Write red, green and blue, atomically. tags: by their numbers, beside those that say where the pixels are; photometry is among them.

    Raises InputError for what is larger than the 4 GB of TIFF.
    """
    if pixels.nbytes > _LARGEST_BYTES:
        raise InputError(f"{path}: a picture of {pixels.shape[1]}x{pixels.shape[0]} px is larger than a TIFF can be (4 GB)")
    height, width, channels = pixels.shape
    all_tags = {
        256: TiffTag(LONG, (width,)),
        257: TiffTag(LONG, (height,)),
        258: TiffTag(SHORT, (16,) * channels),
        259: TiffTag(SHORT, (1,)),
        273: TiffTag(LONG, (_HEADER_BYTES,)),
        277: TiffTag(SHORT, (channels,)),
        278: TiffTag(LONG, (height,)),
        279: TiffTag(LONG, (pixels.nbytes,)),
        284: TiffTag(SHORT, (1,)),
        **tags,
    }
    directory_at = _HEADER_BYTES + pixels.nbytes
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<2sHI", b"II", 42, directory_at))
        file.write(np.ascontiguousarray(pixels, "<u2").data)
        file.write(_directory(all_tags, directory_at))


def _directory(tags: Mapping[int, TiffTag], at: int) -> bytes:
    """Entries in rising order, then the values that do not fit into them, at even places."""
    values_at = at + 2 + _ENTRY_BYTES * len(tags) + 4
    entries, beyond = b"", b""
    for number in sorted(tags):
        count, packed = tags[number].packed()
        if len(packed) <= _INLINE_BYTES:
            place = packed.ljust(_INLINE_BYTES, b"\x00")
        else:
            place = struct.pack("<I", values_at + len(beyond))
            beyond += packed + b"\x00" * (len(packed) % 2)
        entries += struct.pack("<HHI", number, tags[number].kind, count) + place
    return struct.pack("<H", len(tags)) + entries + struct.pack("<I", 0) + beyond
