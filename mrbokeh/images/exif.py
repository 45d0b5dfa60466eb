"""TIFF and EXIF tags of a picture: which way up it is stored, and whether it was cropped since."""

import struct
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from mrbokeh.images.heif import heif_exif, is_heif, open_heif

if TYPE_CHECKING:
    from PIL import Image

TIFF_SUFFIXES = (".tif", ".tiff")
_HEADER_BYTES, _BIG_HEADER_BYTES, _BIG = 8, 16, 43


def tiff_tags(path: Path) -> Mapping[int, Any]:
    """Read the tags of a TIFF's first picture by number; {} if the file is no TIFF or its header is damaged."""
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


SizePx = tuple[int, int]
"""Width, height."""

AS_STORED = 1
_TAG = 0x0112
_OPENING = Lock()
_TELLING = (".png", ".jpg", ".jpeg", ".webp")
# EXIF 2.3: quarter turns counter-clockwise that bring the stored picture upright, and whether it is mirrored left to right first.
_UPRIGHT = {1: (0, False), 2: (0, True), 3: (2, False), 4: (2, True), 5: (1, True), 6: (3, False), 7: (3, True), 8: (1, False)}

Picture = TypeVar("Picture", bound=np.ndarray)


@contextmanager
def header_of(path: Path) -> "Iterator[Image.Image]":
    """Open a picture with Pillow for what its header tells. It may be of any size; Pillow refuses large ones of strangers."""
    from PIL import Image

    with warnings.catch_warnings(action="ignore"):
        with _OPENING:
            most_px, Image.MAX_IMAGE_PIXELS = Image.MAX_IMAGE_PIXELS, None
            try:
                picture = Image.open(path)
            finally:
                Image.MAX_IMAGE_PIXELS = most_px
        with picture:
            yield picture


def stored_orientation(path: Path) -> int:
    """Return EXIF's orientation, 1 to 8; AS_STORED if the file has none, or is HEIC, which is decoded upright."""
    from PIL import Image, UnidentifiedImageError

    suffix = path.suffix.lower()
    if suffix in TIFF_SUFFIXES:
        return known_orientation(tiff_tags(path).get(_TAG))
    if suffix not in _TELLING:
        return AS_STORED
    try:
        with header_of(path) as picture:
            # Not picture.getexif(), which decodes the whole of a PNG to look for the tag behind its pixels.
            return known_orientation(Image.Image.getexif(picture).get(_TAG))
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError):
        return AS_STORED


def exif_and_size(path: Path) -> "tuple[Image.Exif, SizePx] | None":
    """Return the EXIF of a picture (JPEG, TIFF, PNG, WebP, HEIC) and its size as stored; None if it cannot be read."""
    from PIL import Image, UnidentifiedImageError

    try:
        if not is_heif(path):
            with header_of(path) as picture:
                return picture.getexif(), picture.size
        exif = Image.Exif()
        exif.load(heif_exif(path))
        return exif, open_heif(path).size
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError):
        return None


def known_orientation(told: object) -> int:
    """Return the orientation if it is one of EXIF's numbers, else AS_STORED."""
    return told if isinstance(told, int) and told in _UPRIGHT else AS_STORED


def quarter_turns(orientation: int) -> int:
    """Return how many counter-clockwise quarter turns bring the stored picture upright."""
    return _UPRIGHT[orientation][0]


def upright(picture: Picture, orientation: int) -> Picture:
    """Turn a stored picture, (H, W) or (H, W, channels), upright: mirror it left to right if needed, then turn it by quarters."""
    turns, mirrored = _UPRIGHT[orientation]
    return np.ascontiguousarray(np.rot90(picture[:, ::-1] if mirrored else picture, turns))  # type: ignore[return-value]


def upright_place(x: float, y: float, orientation: int) -> tuple[float, float]:
    """Return where a place of the stored picture lies in the upright one; both in shares of width and height."""
    turns, mirrored = _UPRIGHT[orientation]
    x = 1.0 - x if mirrored else x
    for _ in range(turns):
        x, y = y, 1.0 - x
    return x, y


def as_stored(picture: Picture, orientation: int) -> Picture:
    """Turn an upright picture back to how it is stored: the inverse of `upright`."""
    return np.ascontiguousarray(oriented_as_stored(picture, orientation))  # type: ignore[return-value]


def oriented_as_stored(picture: Picture, orientation: int) -> Picture:
    """Return a view of an upright picture as it is stored."""
    turns, mirrored = _UPRIGHT[orientation]
    turned = np.rot90(picture, -turns)
    return turned[:, ::-1] if mirrored else turned  # type: ignore[return-value]


_SAME_ASPECT = 0.01


def as_it_lies(full_px: SizePx, size_px: SizePx) -> SizePx:
    """Return the full size with its sides exchanged if the picture was turned by a quarter since."""
    turned = (size_px[0] < size_px[1]) != (full_px[0] < full_px[1])
    return full_px[::-1] if turned else full_px


def is_same_shape(size_px: SizePx, full_px: SizePx) -> bool:
    """Return whether aspect ratios agree to 1 %: sizes are rounded, and RAW shows a few pixels more than the camera's JPEG."""
    return abs(size_px[0] / size_px[1] * full_px[1] / full_px[0] - 1.0) < _SAME_ASPECT


def cut_from_px(size_px: SizePx, full_px: SizePx | None) -> SizePx | None:
    """Return the full size that a picture was cropped from; None if that is unknown or the picture is whole.

    A picture that does not fit into the full size as taken has been turned by a quarter since.
    """
    if full_px is None or min(*full_px, *size_px) < 1:
        return None
    whole_px = as_it_lies(full_px, size_px)
    if is_same_shape(size_px, whole_px):
        return None
    return full_px if size_px[0] <= full_px[0] and size_px[1] <= full_px[1] else whole_px
