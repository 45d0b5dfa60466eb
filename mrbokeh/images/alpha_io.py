"""The alpha of a plate: read from its file, and carried through to results that can hold it.

A finished picture into a file: in a colour space that the user names, with what says so in its header, and with alpha where it has one.

EXR is premultiplied and states its primaries where they are known; PNG and TIFF hold straight colour, as their standards have it.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.exif import AS_STORED, upright
from mrbokeh.images.exr_io import ATTRIBUTE, ExrPart, read_exr, write_exr
from mrbokeh.images.image_io import INTEGER_SUFFIXES, write_image
from mrbokeh.images.picture_codec import codes_of, even_codes, stored_pixels, write_stored

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


Picture = Float32[np.ndarray, "height width 3"]

_LARGEST_HALF = float(np.finfo(np.float16).max)


def write_finished(path: Path, rgb: Picture, alpha: Plane | None = None, space: NamedSpace | None = None) -> None:
    """rgb: linear Rec.709, premultiplied by alpha; None is opaque. space: None is linear Rec.709 in EXR and sRGB in integers.

    JPEG holds no alpha: what it does not cover is black there.
    """
    suffix = path.suffix.lower()
    if suffix == ".exr":
        write_exr(path, exr_part(in_named_space(rgb, alpha, space), alpha, space))
    elif alpha is None or suffix not in HOLDING_ALPHA:
        write_image(path, rgb if space is None else space.from_rec709(rgb), "srgb" if space is None else "linear")
    else:
        _write_with_alpha(path, straight(rgb, alpha), alpha, space)


def exr_part(rgb: Picture, alpha: Plane | None, space: NamedSpace | None) -> ExrPart:
    """R, G, B and, where there is one, A in half, of numbers that are in the space already."""
    planes = {name: rgb[..., i] for i, name in enumerate("RGB")} | ({} if alpha is None else {"A": alpha})
    channels = {name: np.clip(plane, -_LARGEST_HALF, _LARGEST_HALF).astype(np.float16) for name, plane in planes.items()}
    return ExrPart(channels, attributes=stated(space))


def stated(space: NamedSpace | None) -> dict[str, tuple[float, ...]]:
    """What an EXR header says of a space: nothing where it is Rec.709, as EXR takes it, or its primaries are not known."""
    primaries = None if space is None else space.primaries
    return {} if primaries is None else {ATTRIBUTE: primaries}


def in_named_space(rgb: Picture, alpha: Plane | None, space: NamedSpace | None) -> Picture:
    """Premultiplied before and after; curves are for straight colour, and light without coverage is lost under them."""
    if space is None:
        return rgb
    if alpha is None or space.is_linear:
        return space.from_rec709(rgb)
    return space.from_rec709(straight(rgb, alpha)) * alpha[..., None]


def straight(rgb: Picture, alpha: Plane) -> Picture:
    """Colour divided by coverage; black where nothing is."""
    return np.divide(rgb, alpha[..., None], out=np.zeros_like(rgb), where=alpha[..., None] > 0)


def _write_with_alpha(path: Path, rgb: Picture, alpha: Plane, space: NamedSpace | None) -> None:
    """16 bit, straight."""
    codes = codes_of(rgb, np.uint16, "srgb") if space is None else codes_of(space.from_rec709(rgb), np.uint16, "linear")
    write_stored(path, np.dstack([codes, even_codes(alpha, np.uint16)]))
