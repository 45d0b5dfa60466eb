"""The alpha of a plate: read from its file, and carried through to results that can hold it."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.exif_orientation import AS_STORED, upright
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import INTEGER_SUFFIXES
from mrbokeh.images.picture_codec import stored_pixels

HOLDING_ALPHA = (".exr", ".png", ".tif", ".tiff")
"""Suffixes of pictures in which alpha is stored."""

Plane = Float32[np.ndarray, "height width"]


def read_alpha(path: Path, orientation: int = AS_STORED) -> Plane | None:
    """In [0, 1]; None where the file holds none, or is opaque everywhere. orientation: EXIF's, by which it comes upright."""
    alpha = _stored(path)
    if alpha is None or (alpha >= 1.0).all():
        return None
    return upright(np.clip(alpha, 0.0, 1.0), orientation)


def stores_alpha(path: Path) -> bool:
    """Whether the file holds alpha, be it opaque everywhere."""
    return _stored(path) is not None


def is_straight(path: Path) -> bool:
    """Whether colour is stored as if opaque, as PNG and TIFF have it; that of EXR is multiplied by alpha already."""
    return path.suffix.lower() in INTEGER_SUFFIXES


def alpha_with(plate_alpha: Plane | None, virtual_alpha: Plane) -> Plane | None:
    """Coverage of a plate with virtual light before it; None stays opaque."""
    return None if plate_alpha is None else coverage_with(plate_alpha, virtual_alpha)


def coverage_with(plate_alpha: Plane, virtual_alpha: Plane) -> Plane:
    """Where nothing virtual is, it stays bit for bit."""
    covered = np.clip(virtual_alpha, 0.0, 1.0)
    return np.asarray(covered + (1.0 - covered) * plate_alpha, np.float32)


def _stored(path: Path) -> Plane | None:
    suffix = path.suffix.lower()
    if suffix == ".exr":
        parts = [part for part in read_exr(path) if set("RGBA") <= part.channels.keys()]
        return parts[0].stacked("A")[..., 0] if parts else None
    if suffix not in HOLDING_ALPHA:
        return None
    pixels = stored_pixels(path)
    if pixels.ndim < 3 or pixels.shape[2] < 4:
        return None
    top = 1.0 if pixels.dtype.kind == "f" else float(np.iinfo(pixels.dtype).max)
    return np.asarray(pixels[..., 3] / top, np.float32)
