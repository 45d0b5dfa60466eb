"""A finished picture into a file: in a colour space that the user names, with what says so in its header, and with alpha where it has one.

EXR is premultiplied and states its primaries where they are known; PNG and TIFF hold straight colour, as their standards have it.
"""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.color_management import NamedSpace
from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.images.exr_primaries import ATTRIBUTE
from mrbokeh.images.image_io import write_image
from mrbokeh.images.picture_codec import codes_of, even_codes, write_stored
from mrbokeh.images.plate_alpha import HOLDING_ALPHA

Picture = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

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
