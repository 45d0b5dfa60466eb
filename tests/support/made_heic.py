"""Small HEIC files made for tests: HEVC by PyAV in the boxes of ISO/IEC 23008-12, with profiles, turns, Exif, XMP and depth."""

import struct
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

ICC, NCLX = b"prof", b"nclx"


@dataclass(frozen=True)
class Item:
    """A picture of a HEIC. properties: boxes beside those of HEVC itself.

    codes: (H, W, 3), 8 bits, or 10 bits as uint16 up to 1023; or grey (H, W), 8 bits.
    """

    codes: np.ndarray
    properties: tuple[bytes, ...] = ()
    xmp: bytes = b""
    exif: bytes = b""


@dataclass
class _Boxes:
    """Items, references and places in the file as they are gathered."""

    infos: list[bytes] = field(default_factory=list)
    references: list[bytes] = field(default_factory=list)
    properties: list[bytes] = field(default_factory=list)
    associations: list[bytes] = field(default_factory=list)
    contents: list[bytes] = field(default_factory=list)

    def item(self, kind: bytes, content: bytes, more: bytes = b"") -> int:
        self.contents.append(content)
        number = len(self.contents)
        self.infos.append(full(b"infe", struct.pack(">HH4s", number, 0, kind) + b"\0" + more, version=2))
        return number


def box(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I4s", 8 + len(content), kind) + content


def full(kind: bytes, content: bytes, version: int = 0, flags: int = 0) -> bytes:
    return box(kind, struct.pack(">I", version << 24 | flags) + content)


def turned(quarters: int) -> bytes:
    """irot: counter-clockwise quarter turns."""
    return box(b"irot", bytes([quarters]))


def icc(profile: bytes) -> bytes:
    return box(b"colr", ICC + profile)


def nclx(primaries: int, transfer: int) -> bytes:
    """Full range, with the matrix of BT.601, in which the codes are encoded here."""
    return box(b"colr", NCLX + struct.pack(">HHHB", primaries, transfer, 6, 0x80))


def auxiliary(kind: str) -> bytes:
    return full(b"auxC", kind.encode() + b"\0")


def write_heic(path: Path, main: Item, *aux: Item) -> Path:
    """Write the primary picture, and auxiliary ones that refer to it."""
    boxes = _Boxes()
    primary = _add(boxes, main)
    for each in aux:
        boxes.references.append(box(b"auxl", struct.pack(">HHH", _add(boxes, each), 1, primary)))
    head = box(b"ftyp", b"heic\0\0\0\0mif1heic")
    meta_size = len(_meta(boxes, primary, 0))
    path.write_bytes(head + _meta(boxes, primary, len(head) + meta_size + 8) + box(b"mdat", b"".join(boxes.contents)))
    return path


def _add(boxes: _Boxes, item: Item) -> int:
    pixels, config = _hevc(item.codes)
    number = boxes.item(b"hvc1", pixels)
    height, width = item.codes.shape[:2]
    own = (config, full(b"ispe", struct.pack(">II", width, height)), *item.properties)
    first = len(boxes.properties) + 1
    boxes.properties += own
    # All are essential but the size.
    indices = bytes(first + i | (0 if i == 1 else 0x80) for i in range(len(own)))
    boxes.associations.append(struct.pack(">HB", number, len(own)) + indices)
    for kind, content, more in (
        (b"mime", item.xmp, b"application/rdf+xml\0"),
        (b"Exif", item.exif and b"\0\0\0\x06Exif\0\0" + item.exif, b""),
    ):
        if content:
            boxes.references.append(box(b"cdsc", struct.pack(">HHH", boxes.item(kind, content, more), 1, number)))
    return number


def _meta(boxes: _Boxes, primary: int, start: int) -> bytes:
    places, at = [], start
    for number, content in enumerate(boxes.contents, 1):
        places.append(struct.pack(">HHHII", number, 0, 1, at, len(content)))
        at += len(content)
    return full(
        b"meta",
        full(b"hdlr", struct.pack(">I4s12x", 0, b"pict") + b"\0")
        + full(b"pitm", struct.pack(">H", primary))
        + full(b"iloc", struct.pack(">HH", 0x4400, len(places)) + b"".join(places))
        + full(b"iinf", struct.pack(">H", len(boxes.infos)) + b"".join(boxes.infos))
        + box(
            b"iprp",
            box(b"ipco", b"".join(boxes.properties))
            + full(b"ipma", struct.pack(">I", len(boxes.associations)) + b"".join(boxes.associations)),
        )
        + full(b"iref", b"".join(boxes.references)),
    )


def _hevc(codes: np.ndarray) -> tuple[bytes, bytes]:
    """Encode losslessly (but for the conversion to YCbCr) and return the picture with lengths before its parts, and its hvcC box."""
    deep, grey = codes.dtype == np.uint16, codes.ndim == 2
    encoder = av.CodecContext.create("libx265", "w")
    encoder.height, encoder.width = codes.shape[:2]
    encoder.pix_fmt, encoder.time_base = "gray" if grey else "yuv444p10le" if deep else "yuv444p", Fraction(1, 25)
    encoder.options = {"x265-params": "lossless=1:log-level=none:keyint=1:range=full:colormatrix=smpte170m:repeat-headers=1:info=0"}
    frame = av.VideoFrame(encoder.width, encoder.height, encoder.pix_fmt)
    for plane, numbers in zip(frame.planes, [codes] if grey else np.moveaxis(_ycbcr(codes), 2, 0), strict=True):
        rows = np.zeros((plane.height, plane.line_size // numbers.itemsize), numbers.dtype)
        rows[:, : plane.width] = numbers
        plane.update(rows.tobytes())
    stream = b"".join(bytes(packet) for packet in (*encoder.encode(frame), *encoder.encode(None)))
    parts = [each.rstrip(b"\0") for each in stream.split(b"\0\0\1")[1:]]
    heads = [[each for each in parts if each[0] >> 1 & 0x3F == kind] for kind in (32, 33, 34)]
    picture = b"".join(struct.pack(">I", len(each)) + each for each in parts if each[0] >> 1 & 0x3F < 32)
    depth = 2 if deep else 0
    arrays = b"".join(
        struct.pack(">BH", 0x80 | kind, len(each)) + b"".join(struct.pack(">H", len(nal)) + nal for nal in each)
        for kind, each in zip((32, 33, 34), heads, strict=True)
    )
    general = b"\1\4" + b"\0" * 10 + b"\x5d\xf0\0\xfc" + bytes([0xFC if grey else 0xFF, 0xF8 | depth, 0xF8 | depth]) + b"\0\0\x0f\3"
    return picture, box(b"hvcC", general + arrays)


def _ycbcr(codes: np.ndarray) -> np.ndarray:
    """BT.601 in full range."""
    top = 1023 if codes.dtype == np.uint16 else 255
    red, green, blue = np.moveaxis(codes / top, 2, 0)
    luma = 0.299 * red + 0.587 * green + 0.114 * blue
    middle = (top + 1) / 2 / top
    planes = np.stack([luma, middle + (blue - luma) / 1.772, middle + (red - luma) / 1.402], axis=2)
    return np.clip(np.round(planes * top), 0, top).astype(codes.dtype)
