"""Which way up a picture is stored, as EXIF tells, and how it is brought upright."""

from pathlib import Path
from typing import TypeVar

import numpy as np

from mrbokeh.images.tiff_tags import TIFF_SUFFIXES, tiff_tags

AS_STORED = 1
_TAG = 0x0112
_TELLING = (".png", ".jpg", ".jpeg", ".webp")
# EXIF 2.3: quarter turns counter-clockwise that bring the stored picture upright, and whether it is mirrored left to right first.
_UPRIGHT = {1: (0, False), 2: (0, True), 3: (2, False), 4: (2, True), 5: (1, True), 6: (3, False), 7: (3, True), 8: (1, False)}

Picture = TypeVar("Picture", bound=np.ndarray)


def stored_orientation(path: Path) -> int:
    """EXIF's number, 1 to 8; AS_STORED where the file tells none."""
    from PIL import Image, UnidentifiedImageError

    suffix = path.suffix.lower()
    if suffix in TIFF_SUFFIXES:
        return known_orientation(tiff_tags(path).get(_TAG))
    if suffix not in _TELLING:
        return AS_STORED
    try:
        with Image.open(path) as picture:
            # Not picture.getexif(), which decodes the whole of a PNG to look for the tag behind its pixels.
            return known_orientation(Image.Image.getexif(picture).get(_TAG))
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError):
        return AS_STORED


def known_orientation(told: object) -> int:
    """AS_STORED where it is none of EXIF's numbers."""
    return told if isinstance(told, int) and told in _UPRIGHT else AS_STORED


def quarter_turns(orientation: int) -> int:
    """Counter-clockwise, that bring the stored picture upright."""
    return _UPRIGHT[orientation][0]


def upright(picture: Picture, orientation: int) -> Picture:
    """A picture as it is stored, (H, W) or (H, W, channels): mirrored left to right where asked, then turned by quarters."""
    turns, mirrored = _UPRIGHT[orientation]
    return np.ascontiguousarray(np.rot90(picture[:, ::-1] if mirrored else picture, turns))  # type: ignore[return-value]


def as_stored(picture: Picture, orientation: int) -> Picture:
    """The other way round."""
    turns, mirrored = _UPRIGHT[orientation]
    turned = np.rot90(picture, -turns)
    return np.ascontiguousarray(turned[:, ::-1] if mirrored else turned)  # type: ignore[return-value]
