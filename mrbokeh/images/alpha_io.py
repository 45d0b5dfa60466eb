"""Pictures with alpha in and out: the alpha of a plate, and finished pictures in a colour space that the user names.

EXR is premultiplied and states its colour space; PNG and TIFF hold straight colour, as their standards ask.
"""

from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.exif import AS_STORED, upright
from mrbokeh.images.exr_io import ATTRIBUTE, INTEROP_ID, INTEROP_IDS, SPACE_NAME, STATED_REC709, ExrPart, headers_of, read_exr, write_exr
from mrbokeh.images.image_io import INTEGER_SUFFIXES, write_image
from mrbokeh.images.picture_codec import codes_of, even_codes, stored_pixels, write_stored

HOLDING_ALPHA = (".exr", ".png", ".tif", ".tiff")
"""Suffixes of pictures in which alpha is stored."""

Plane = Float32[np.ndarray, "height width"]


def read_alpha(path: Path, orientation: int = AS_STORED) -> Plane | None:
    """Read alpha in [0, 1]; None if the file has none or is opaque everywhere. orientation: EXIF's number, by which it comes upright."""
    alpha = _stored(path)
    if alpha is None or (alpha >= 1.0).all():
        return None
    return upright(np.clip(alpha, 0.0, 1.0), orientation)


def stores_alpha(path: Path) -> bool:
    """Return whether the file has an alpha channel, even if it is opaque everywhere."""
    return _stored(path) is not None


def is_straight(path: Path) -> bool:
    """Return whether colour is stored unpremultiplied, as in PNG and TIFF; EXR is premultiplied."""
    return path.suffix.lower() in INTEGER_SUFFIXES


def alpha_with(plate_alpha: Plane | None, virtual_alpha: Plane) -> Plane | None:
    """Return the coverage of a plate behind virtual light; None stays opaque."""
    return None if plate_alpha is None else coverage_with(plate_alpha, virtual_alpha)


def coverage_with(plate_alpha: Plane, virtual_alpha: Plane) -> Plane:
    """Return the coverage of a plate behind virtual light, bit for bit the plate's own where nothing virtual is."""
    covered = np.clip(virtual_alpha, 0.0, 1.0)
    return np.asarray(covered + (1.0 - covered) * plate_alpha, np.float32)


def _stored(path: Path) -> Plane | None:
    suffix = path.suffix.lower()
    if suffix == ".exr":
        if not any(channel.name == "A" for header in headers_of(path) for channel in header["channels"]):
            return None
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
    """Write a finished picture in the format of its suffix.

    rgb: linear Rec.709, premultiplied by alpha; None is opaque. space: None is linear Rec.709 in EXR and sRGB in integers.
    JPEG has no alpha: uncovered pixels are black there.
    """
    suffix = path.suffix.lower()
    if suffix == ".exr":
        write_exr(path, exr_part(in_named_space(rgb, alpha, space), alpha, space))
    elif alpha is None or suffix not in HOLDING_ALPHA:
        write_image(path, rgb if space is None else space.from_rec709(rgb), "srgb" if space is None else "linear")
    else:
        _write_with_alpha(path, straight(rgb, alpha), alpha, space)


def exr_part(rgb: Picture, alpha: Plane | None, space: NamedSpace | None) -> ExrPart:
    """Return R, G, B and, if given, A in half floats; the numbers must be in the space already."""
    planes = {name: rgb[..., i] for i, name in enumerate("RGB")} | ({} if alpha is None else {"A": alpha})
    channels = {name: np.clip(plane, -_LARGEST_HALF, _LARGEST_HALF).astype(np.float16) for name, plane in planes.items()}
    return ExrPart(channels, attributes=stated(space))


def stated(space: NamedSpace | None) -> dict[str, Any]:
    """Return the header entries that state a colour space: its name, and its primaries if it is linear and they are a public standard's.

    None is linear Rec.709.
    """
    if space is None:
        return dict(STATED_REC709)
    primaries, name = space.primaries, {SPACE_NAME: space.name}
    return name if primaries is None else {ATTRIBUTE: primaries, INTEROP_ID: INTEROP_IDS[primaries], **name}


def in_named_space(rgb: Picture, alpha: Plane | None, space: NamedSpace | None) -> Picture:
    """Convert a premultiplied picture to a space, dividing by alpha first if the space has a curve; light without coverage is lost then."""
    if space is None:
        return rgb
    if alpha is None or space.is_linear:
        return space.from_rec709(rgb)
    return space.from_rec709(straight(rgb, alpha)) * alpha[..., None]


def straight(rgb: Picture, alpha: Plane) -> Picture:
    """Return colour divided by coverage; black where nothing is covered."""
    return np.divide(rgb, alpha[..., None], out=np.zeros_like(rgb), where=alpha[..., None] > 0)


def _write_with_alpha(path: Path, rgb: Picture, alpha: Plane, space: NamedSpace | None) -> None:
    """Write 16-bit straight colour with alpha."""
    codes = codes_of(rgb, np.uint16, "srgb") if space is None else codes_of(space.from_rec709(rgb), np.uint16, "linear")
    write_stored(path, np.dstack([codes, even_codes(alpha, np.uint16)]))
