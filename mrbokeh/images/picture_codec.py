"""PNG, TIFF, JPEG, WebP and HDR files to and from the numbers that they store, and these to and from scene-linear light."""

from pathlib import Path
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Shaped

from mrbokeh.images.color import srgb_to_linear
from mrbokeh.images.png_chunks import without_chatter
from mrbokeh.images.quiet_opencv import quiet_opencv
from mrbokeh.images.srgb_codes import srgb_codes
from mrbokeh.images.tiff_pixels import tiff_as_stored, with_straight_alpha
from mrbokeh.images.tiff_tags import TIFF_SUFFIXES
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError

Encoding = Literal["srgb", "linear"]

_INTEGER_RANGE = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0}
_SWAPPED_BY_OPENCV = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))


def stored_pixels(path: Path) -> np.ndarray:
    """The numbers of a PNG, TIFF, JPEG, WebP or HDR file as they are stored: (H, W) or (H, W, 3 or 4) with blue first.

    Raises InputError where the file is empty or damaged.
    """
    import cv2

    data = np.fromfile(path, np.uint8)
    if not data.size:
        raise InputError(f"{path} is empty: copy or render it again")
    sound = without_chatter(data)
    with quiet_opencv():
        pixels = None if sound is None else cv2.imdecode(sound, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InputError(f"{path} cannot be read as a picture: it is damaged or not what its suffix says")
    return tiff_as_stored(path, pixels) if path.suffix.lower() in TIFF_SUFFIXES else np.asarray(pixels)


def stored_rgb(path: Path) -> Shaped[np.ndarray, "height width channels"]:
    """The stored numbers as (H, W, 3 or 4), red first; grey is repeated."""
    import cv2

    pixels = stored_pixels(path)
    if pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=2)
    if pixels.dtype in _SWAPPED_BY_OPENCV:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGBA))
    order = [2, 1, 0] if pixels.shape[2] == 3 else [2, 1, 0, 3]
    return np.ascontiguousarray(pixels[..., order])


def write_stored(path: Path | str, pixels: Shaped[np.ndarray, "height width *channels"]) -> None:
    """(H, W) or (H, W, 3 or 4) codes with red first, in the format of the suffix. Raises InputError where that does not hold them."""
    import cv2

    suffix = Path(path).suffix.lower()
    if pixels.ndim == 3:
        pixels = cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_RGB2BGR if pixels.shape[2] == 3 else cv2.COLOR_RGBA2BGRA)
    done, data = cv2.imencode(suffix, pixels)
    if not done:
        raise InputError(f"cannot encode a picture of shape {pixels.shape} as {suffix}")
    says_alpha = suffix in TIFF_SUFFIXES and pixels.ndim == 3 and pixels.shape[2] == 4
    with atomic_path(path) as temporary:
        temporary.write_bytes(with_straight_alpha(data.tobytes()) if says_alpha else data.data)


def linear_from_codes(
    codes: Shaped[np.ndarray, "height width channels"], encoding: Encoding, path: Path
) -> Float32[np.ndarray, "height width channels"]:
    """Codes of 8 or 16 bits as scene-linear light; alpha, a fourth channel, is never curved. path: of the file, for the error."""
    if codes.dtype not in _INTEGER_RANGE:
        raise InputError(f"{path} stores {codes.dtype}: expected 8 or 16 bit integers or float")
    top = np.float32(_INTEGER_RANGE[codes.dtype])
    if encoding != "srgb":
        return codes / top
    linear = _looked_up(srgb_to_linear(np.arange(int(top) + 1) / top), codes[..., :3])
    return linear if codes.shape[2] == 3 else np.dstack([linear, codes[..., 3] / top])


def _looked_up(
    table: Float32[np.ndarray, " codes"], codes: Shaped[np.ndarray, "height width channels"]
) -> Float32[np.ndarray, "height width channels"]:
    """The entry of each code; by OpenCV for 8 bits, which its tables are for."""
    import cv2

    return np.asarray(cv2.LUT(np.ascontiguousarray(codes), table)) if codes.dtype == np.uint8 else table[codes]


def codes_of(rgb: Float32[np.ndarray, "height width 3"], dtype: type, encoding: Encoding) -> Shaped[np.ndarray, "height width 3"]:
    """Codes of dtype (uint8 or uint16) of scene-linear light; 0 to 1 becomes 0 to the largest, what is beyond is clipped, NaN is 0."""
    return srgb_codes(rgb, dtype) if encoding == "srgb" else even_codes(rgb, dtype)


def even_codes(values: Float[np.ndarray, "*shape"], dtype: type) -> Shaped[np.ndarray, "*shape"]:
    """Codes at even steps, without a curve."""
    return np.round(np.clip(np.nan_to_num(values), 0, 1) * np.iinfo(dtype).max).astype(dtype)
