"""Masks that people paint in any picture editor: what is white in them, as the sensor saw it."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.exif import as_stored, stored_orientation, upright
from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import require_suffix
from mrbokeh.images.picture_codec import stored_pixels
from mrbokeh.system.errors import InputError

MASK_SUFFIXES = (".png", ".tif", ".tiff", ".exr")
_ALPHA, _COLOURS = 3, 3
_PAINTED = (0.1, 0.9)
_LARGEST_UNPAINTED = 0.6
"""Share of pixels that are neither black nor white: soft brushes leave rims, a photograph is nearly all between."""

Plane = Float32[np.ndarray, "height width"]


def read_mask(path: Path, shape: tuple[int, int], orientation: int) -> Plane:
    """Return how white each pixel is, 0 to 1, as the sensor saw it. shape: (H, W) there; orientation: what brings that upright, by EXIF.

    A mask is of the size of the upright picture or of that of the sensor. Where these are the same, PNG and TIFF stand upright and EXR
    does not, as the pictures of a stack do. What is transparent is black.
    """
    require_suffix(path, MASK_SUFFIXES, "--mask")
    if not path.is_file():
        raise InputError(f"--mask: expected a picture at {path}, but there is no such file")
    is_exr = path.suffix.lower() == ".exr"
    white = _of_exr(path) if is_exr else upright(_of_codes(path), stored_orientation(path))
    if not np.isfinite(white).all():
        raise InputError(f"{path}: {int((~np.isfinite(white)).sum())} pixels are NaN or infinite: paint the mask from 0 (black) to 1")
    white = np.clip(white, 0.0, 1.0).astype(np.float32)
    between = float(((white > _PAINTED[0]) & (white < _PAINTED[1])).mean())
    if between > _LARGEST_UNPAINTED:
        raise InputError(
            f"{path}: {between:.0%} of it is neither black nor white: expected white strokes on black, not the photograph itself"
        )
    upright_shape = upright(np.empty(shape, np.bool_), orientation).shape
    if white.shape == upright_shape and not (is_exr and white.shape == shape):
        return as_stored(white, orientation)
    if white.shape != shape:
        size, expected = (f"{each[1]} x {each[0]}" for each in (white.shape, upright_shape))
        raise InputError(f"{path} has {size} px, but the stack's pictures have {expected} px: paint the mask over all_in_focus.png")
    return white


def _of_codes(path: Path) -> Plane:
    pixels = stored_pixels(path)
    if pixels.dtype.kind != "f" and pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path} stores {pixels.dtype}: expected a mask of 8 or 16 bits, or of float")
    top = np.float32(1.0 if pixels.dtype.kind == "f" else np.iinfo(pixels.dtype).max)
    shares = pixels.astype(np.float32) / top
    if shares.ndim == 2:
        return shares
    white = shares[..., :_COLOURS].mean(axis=2)
    return np.asarray(white * shares[..., _ALPHA] if shares.shape[2] > _ALPHA else white, np.float32)


def _of_exr(path: Path) -> Plane:
    """Colour, which EXR has multiplied by alpha already, else the only channel."""
    part = read_exr(path)[0]
    if set("RGB") <= part.channels.keys():
        return np.asarray(part.stacked("RGB").mean(axis=2), np.float32)
    if len(part.channels) > 1 and "Y" not in part.channels:
        raise InputError(f"{path}: expected a mask in R, G, B, in Y or in one channel, but it has {', '.join(sorted(part.channels))}")
    return np.asarray(part.channels.get("Y", next(iter(part.channels.values()))), np.float32)
