"""HEIC photographs through pi-heif (libheif and libde265, extra `heic`): pixels, Exif, XMP and auxiliary pictures.

Files are turned upright as they state by irot and imir, and their Exif orientation, which says the same again, is not applied. Of
several pictures, such as the two of a spatial photograph, the primary is read. Gain maps, by which phones brighten highlights on HDR
screens, lie beside the picture and do not change it; they are not read. Alpha is not read.
"""

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.system.errors import InputError, install_command

HEIF_SUFFIXES = (".heic", ".heif", ".hif")
_BY = "by `heif-convert IN.heic OUT.png` (libheif), `magick IN.heic OUT.png`, or on a Mac `sips -s format jpeg IN.heic --out OUT.jpg`"


def is_heif(path: Path) -> bool:
    """Return whether a file is HEIC, by its suffix."""
    return path.suffix.lower() in HEIF_SUFFIXES


def has_heif() -> bool:
    """Return whether the extra that reads HEIC is installed."""
    return find_spec("pi_heif") is not None


def heif_advice() -> str:
    """Return why a HEIC is not read, and what to do."""
    return (
        f"HEIC is not read: add the extra that reads it ({install_command('heic')}), or convert it to PNG or TIFF of 16 bits, or to JPEG, "
        f"such as {_BY}"
    )


def open_heif(path: Path) -> Any:
    """Open a HEIC without decoding its pixels yet. Raises InputError where it is damaged, or where the extra is not installed."""
    if not has_heif():
        raise InputError(f"{path}: {heif_advice()}")
    import pi_heif

    try:
        return pi_heif.open_heif(path, convert_hdr_to_8bit=False, bgr_mode=True)
    except _DAMAGED:
        raise InputError(f"{path} cannot be read as a picture: it is damaged or not what its suffix says") from None


_DAMAGED = (ValueError, EOFError, SyntaxError, RuntimeError, OSError)


def heif_pixels(path: Path) -> np.ndarray:
    """Decode the primary picture: (H, W) or (H, W, 3), blue first, upright; 8 bits, or more as 16-bit codes from 0 to 65535."""
    opened = open_heif(path)
    try:
        pixels = plane_of(opened)
    except _DAMAGED:
        raise InputError(f"{path} cannot be read as a picture: its pixels are damaged or cut short: copy it again") from None
    colour = pixels[..., 0] if pixels.shape[2] < 3 else pixels[..., :3]
    return np.ascontiguousarray(colour)


def plane_of(picture: Any) -> np.ndarray:
    """Decode one picture of a HEIC as (H, W, channels)."""
    data, mode, (width, height) = picture.data, picture.mode, picture.size
    channels = len(mode.partition(";")[0])
    if ";" not in mode:
        return np.frombuffer(data, np.uint8).reshape(height, width, channels).copy()
    codes = np.frombuffer(data, np.uint16).reshape(height, width, channels)
    # libheif leaves the codes of 10 or 12 bits at the upper end of 16.
    bits = int(getattr(picture, "info", {}).get("bit_depth", 16))
    whole_range = np.round(np.arange(1 << bits) * (65535.0 / ((1 << bits) - 1))).astype(np.uint16)
    return np.take(whole_range, codes >> (16 - bits))


def heif_exif(path: Path) -> bytes:
    """Return the Exif block of a HEIC; empty if it has none."""
    return bytes(open_heif(path).info.get("exif") or b"")
