"""Reading of some rows of an EXR file without the rest of it.

Training on crops of large pictures would otherwise decode 24 megapixels for each crop. Uncompressed scan lines (depth, the
all-in-focus picture and small slices of this project) and those in ZIP blocks (https://openexr.com/en/latest/OpenEXRFileLayout.html)
are found and decoded here, because OpenEXR's own Python module blocks all other threads while it decodes. Scan lines in other blocks
(PIZ, used for large slices) are decoded by that module, these rows only; tiles and cropped pictures are read whole and cut.
"""

import functools
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.exr_io import read_exr
from mrbokeh.stacks.exr_layers._exr_numba import without_prediction
from mrbokeh.system.errors import InputError

Rows = Float32[np.ndarray, "rows width"]

_MAGIC = b"v/1\x01"
_PLAIN_FLAGS = 0x400  # long names are fine; tiles, deep pixels and several parts are not
_LINES_PER_BLOCK = {0: 1, 2: 1, 3: 16}  # compression: none, ZIPS, ZIP
_PIXEL_TYPES: dict[int, np.dtype] = {1: np.dtype("<f2"), 2: np.dtype("<f4")}
_KEPT_HEADERS = 4096


@dataclass(frozen=True)
class _Layout:
    """The layout of a file. offsets: where each block starts. channels: (name, type) in the order of the file."""

    height: int
    width: int
    compressed: bool
    lines_per_block: int
    channels: tuple[tuple[str, np.dtype], ...]
    offsets: tuple[int, ...]

    @property
    def line_bytes(self) -> int:
        return self.width * sum(kind.itemsize for _, kind in self.channels)


def exr_size_px(path: Path) -> tuple[int, int]:
    """Return (height, width) of the first part; for scan lines only the header is read."""
    layout = _layout_of(path)
    if layout is not None:
        return layout.height, layout.width
    if (opened := _opened(path)) is not None:
        return opened[1]
    shape = next(iter(read_exr(path)[0].channels.values())).shape
    return shape[0], shape[1]


def read_rows(path: Path, rows: slice, names: Sequence[str] = (), optional: Sequence[str] = ()) -> dict[str, Rows]:
    """Read the named channels of the first part as float32 (rows, width), and those of `optional` that the file has.

    rows: a plain slice within the picture. Raises InputError if the file is missing or damaged or lacks a channel.
    """
    layout = _layout_of(path)
    if layout is None and (found_by_rows := _decoded_by_openexr(path, rows, (*names, *optional))) is not None:
        found = found_by_rows
    elif layout is None:
        whole = read_exr(path)[0].channels
        found = {name: whole[name][rows].astype(np.float32) for name in (*names, *optional) if name in whole}
    else:
        wanted = [name for name, _ in layout.channels if name in names or name in optional]
        try:
            found = _decoded(path, layout, rows, wanted)
        except (OSError, ValueError, zlib.error, struct.error) as error:
            raise InputError(f"{path} cannot be read as EXR: {error}") from None
    missing = [name for name in names if name not in found]
    if missing:
        raise InputError(f"{path}: expected the EXR channels {list(names)}, but {missing} are missing: merge or ingest the stack again")
    return found


def _opened(path: Path) -> tuple[Any, tuple[int, int]] | None:
    """Return (the file in OpenEXR's older interface, which reads some rows alone, (height, width)).

    None if it is not a whole picture in scan lines or cannot be opened.
    """
    import OpenEXR

    try:
        file = OpenEXR.InputFile(str(path))
        header = file.header()
        data, display = header["dataWindow"], header["displayWindow"]
    except (OSError, KeyError, RuntimeError, ValueError):
        return None
    if "tiles" in header or (data.min.x, data.min.y, data.max.x, data.max.y) != (0, 0, display.max.x, display.max.y):
        return None
    return file, (data.max.y + 1, data.max.x + 1)


def _decoded_by_openexr(path: Path, rows: slice, wanted: Sequence[str]) -> dict[str, Rows] | None:
    """Return those of the wanted channels that the file has; None if it has to be read whole."""
    import Imath

    opened = _opened(path)
    if opened is None:
        return None
    file, (_, width) = opened
    names = [name for name in wanted if name in file.header()["channels"]]
    planes = file.channels(names, Imath.PixelType(Imath.PixelType.FLOAT), rows.start, rows.stop - 1)
    return {name: np.frombuffer(plane, np.float32).reshape(-1, width) for name, plane in zip(names, planes, strict=True)}


def _decoded(path: Path, layout: _Layout, rows: slice, wanted: Sequence[str]) -> dict[str, Rows]:
    found = {name: np.empty((rows.stop - rows.start, layout.width), np.float32) for name in wanted}
    lines = layout.lines_per_block
    with path.open("rb") as file:
        for block in range(rows.start // lines, -(-rows.stop // lines)):
            top = block * lines
            pixels = _block(file, layout, block, min(lines, layout.height - top))
            first, last = max(rows.start, top), min(rows.stop, top + len(pixels))
            start = 0
            for name, kind in layout.channels:
                stop = start + layout.width * kind.itemsize
                if name in found:
                    found[name][first - rows.start : last - rows.start] = pixels[first - top : last - top, start:stop].view(kind)
                start = stop
    return found


def _block(file: BinaryIO, layout: _Layout, block: int, lines: int) -> np.ndarray:
    """Return (lines, line_bytes) uint8. A block that compression would have enlarged is stored uncompressed."""
    file.seek(layout.offsets[block])
    _, length = struct.unpack("<ii", file.read(8))
    stored, size = file.read(length), lines * layout.line_bytes
    if layout.compressed and length < size:
        return without_prediction(np.frombuffer(zlib.decompress(stored, bufsize=size), np.uint8)).reshape(lines, layout.line_bytes)
    return np.frombuffer(stored, np.uint8, size).reshape(lines, layout.line_bytes)


def _layout_of(path: Path) -> _Layout | None:
    """Return None if the file is not plain scan lines of half and float, or its picture is not its display window."""
    try:
        changed = path.stat()
    except OSError:
        raise InputError(f"expected an EXR file at {path}, but there is none") from None
    return _parsed(path, changed.st_mtime_ns, changed.st_size)


@functools.lru_cache(maxsize=_KEPT_HEADERS)
def _parsed(path: Path, _changed_ns: int, _size: int) -> _Layout | None:
    try:
        with path.open("rb") as file:
            return _parse(file)
    except (OSError, ValueError, KeyError, struct.error):
        return None


def _parse(file: BinaryIO) -> _Layout | None:
    magic, version, flags_low, flags_high = struct.unpack("<4sBBH", file.read(8))
    if magic != _MAGIC or version != 2 or ((flags_low << 8) | (flags_high << 16)) & ~_PLAIN_FLAGS:
        return None
    header = {}
    while name := _word(file):
        _word(file)
        header[name] = file.read(struct.unpack("<i", file.read(4))[0])
    compression, window = header["compression"][0], struct.unpack("<4i", header["dataWindow"])
    if compression not in _LINES_PER_BLOCK or header["dataWindow"] != header["displayWindow"]:
        return None
    height, width, lines = window[3] - window[1] + 1, window[2] - window[0] + 1, _LINES_PER_BLOCK[compression]
    count = -(-height // lines)
    offsets = struct.unpack(f"<{count}Q", file.read(8 * count))
    return _Layout(
        height=height,
        width=width,
        compressed=compression > 0,
        lines_per_block=lines,
        channels=_channels(header["channels"]),
        offsets=offsets,
    )


def _channels(entries: bytes) -> tuple[tuple[str, np.dtype], ...]:
    found: list[tuple[str, np.dtype]] = []
    while entries[0]:
        name, rest = entries.split(b"\0", 1)
        kind, _, across, down = struct.unpack("<iIii", rest[:16])
        if (across, down) != (1, 1):
            raise ValueError("subsampled channels")
        found.append((name.decode(), _PIXEL_TYPES[kind]))
        entries = rest[16:]
    return tuple(found)


def _word(file: BinaryIO) -> str:
    """Read a text that ends with a zero byte; "" ends the header."""
    letters = bytearray()
    while (letter := file.read(1)) not in (b"\0", b""):
        letters += letter
    return letters.decode()
