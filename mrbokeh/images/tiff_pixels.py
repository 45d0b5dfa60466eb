"""Pixels of a TIFF as its file stores them.

OpenCV turns a TIFF as its tag Orientation says, unlike pictures of other formats, and multiplies straight colour of 8 bits by alpha, as
libtiff's reader of RGBA does; neither is wanted where files of all formats are to be treated alike. What it writes does not say what the
fourth channel is.
"""

import struct
from io import BytesIO
from pathlib import Path

import numpy as np

from mrbokeh.images.exif_orientation import as_stored, known_orientation
from mrbokeh.images.tiff_tags import tiff_tags

_ORIENTATION, _EXTRA_SAMPLES = 274, 338
_ASSOCIATED, _STRAIGHT = 1, 2
_SHORT, _ENTRY_BYTES = 3, 12


def tiff_as_stored(path: Path, decoded: np.ndarray) -> np.ndarray:
    """decoded: by OpenCV, (H, W) or (H, W, 3 or 4) with blue first. Colour that is multiplied by alpha is divided by it, code by code."""
    tags = tiff_tags(path)
    extra = tags.get(_EXTRA_SAMPLES, ())
    has_alpha = decoded.ndim == 3 and decoded.shape[2] == 4 and len(extra) == 1
    upright = _by_pillow(path) if has_alpha and extra[0] == _STRAIGHT and decoded.dtype == np.uint8 else decoded
    stored = as_stored(upright, known_orientation(tags.get(_ORIENTATION)))
    return _divided(stored) if has_alpha and extra[0] == _ASSOCIATED else stored


def with_straight_alpha(encoded: bytes) -> bytes:
    """A TIFF of four channels as OpenCV encodes it, whose header then says that the fourth is alpha, not multiplied into colour.

    The tags are written anew behind all else, for they stand in rising order. Other TIFFs come back as they are.
    """
    if encoded[:4] != b"II*\x00":
        return encoded
    (first,) = struct.unpack_from("<I", encoded, 4)
    (count,) = struct.unpack_from("<H", encoded, first)
    entries = [encoded[at : at + _ENTRY_BYTES] for at in range(first + 2, first + 2 + _ENTRY_BYTES * count, _ENTRY_BYTES)]
    if any(entry[:2] == struct.pack("<H", _EXTRA_SAMPLES) for entry in entries):
        return encoded
    entries.append(struct.pack("<HHIHH", _EXTRA_SAMPLES, _SHORT, 1, _STRAIGHT, 0))
    entries.sort(key=lambda entry: struct.unpack_from("<H", entry))
    following = encoded[first + 2 + _ENTRY_BYTES * count :][:4]
    body = encoded + b"\x00" * (len(encoded) % 2)
    tags = struct.pack("<H", len(entries)) + b"".join(entries) + following
    return body[:4] + struct.pack("<I", len(body)) + body[8:] + tags


def _by_pillow(path: Path) -> np.ndarray:
    """Turned as well, but not multiplied. From memory: Pillow 13 confuses rows and columns of a file that it maps and turns."""
    from PIL import Image

    with Image.open(BytesIO(path.read_bytes())) as picture:
        return np.ascontiguousarray(np.asarray(picture.convert("RGBA"))[..., [2, 1, 0, 3]])


def _divided(multiplied: np.ndarray) -> np.ndarray:
    """Straight colour; what nothing covers is black."""
    top = 1.0 if multiplied.dtype.kind == "f" else float(np.iinfo(multiplied.dtype).max)
    alpha = multiplied[..., 3:].astype(np.float64)
    colour = np.divide(multiplied[..., :3] * top, alpha, out=np.zeros(multiplied[..., :3].shape), where=alpha > 0)
    if multiplied.dtype.kind != "f":
        colour = np.round(np.minimum(colour, top))
    return np.concatenate([colour.astype(multiplied.dtype), multiplied[..., 3:]], axis=2)
