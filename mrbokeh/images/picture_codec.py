"""PNG, TIFF, JPEG, WebP, HEIC and HDR files to and from the numbers that they store, and these to and from scene-linear light.

OpenCV turns a TIFF by its tag Orientation, unlike other formats, and multiplies straight 8-bit colour by alpha, as libtiff's RGBA
reader does; both are undone here so that all formats are treated alike. PNG chunks that carry no pixels are dropped before decoding,
because libpng writes its complaints about them to standard error.
"""

import struct
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path
from threading import Lock
from typing import Literal

import numpy as np
from jaxtyping import Float, Float32, Shaped, UInt8

from mrbokeh.images.color import srgb_codes, srgb_to_linear
from mrbokeh.images.color_profiles import ColourProfile, profile_of
from mrbokeh.images.exif import TIFF_SUFFIXES, as_stored, known_orientation, tiff_tags
from mrbokeh.images.heif import heif_pixels, is_heif
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError

_ORIENTATION, _EXTRA_SAMPLES = 274, 338
_ASSOCIATED, _STRAIGHT = 1, 2
_SHORT, _ENTRY_BYTES = 3, 12


def tiff_as_stored(path: Path, decoded: np.ndarray) -> np.ndarray:
    """Undo what OpenCV did to a TIFF: its orientation, and the multiplication by alpha.

    decoded: by OpenCV, (H, W) or (H, W, 3 or 4), blue first. Colour that is stored multiplied by alpha is divided by it, code by code.
    """
    tags = tiff_tags(path)
    extra = tags.get(_EXTRA_SAMPLES, ())
    has_alpha = decoded.ndim == 3 and decoded.shape[2] == 4 and len(extra) == 1
    upright = _by_pillow(path) if has_alpha and extra[0] == _STRAIGHT and decoded.dtype == np.uint8 else decoded
    stored = as_stored(upright, known_orientation(tags.get(_ORIENTATION)))
    return _divided(stored) if has_alpha and extra[0] == _ASSOCIATED else stored


def with_straight_alpha(encoded: bytes) -> bytes:
    """Mark the fourth channel of a TIFF that OpenCV encoded as alpha that is not multiplied into colour.

    The tags are rewritten at the end of the file, because they stand in rising order. Other TIFFs come back as they are.
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
    """Decode a TIFF turned upright but not multiplied. From memory, as Pillow 13 confuses rows and columns of a mapped, turned file."""
    from PIL import Image

    with Image.open(BytesIO(path.read_bytes())) as picture:
        return np.ascontiguousarray(np.asarray(picture.convert("RGBA"))[..., [2, 1, 0, 3]])


def _divided(multiplied: np.ndarray) -> np.ndarray:
    """Return straight colour; uncovered pixels are black."""
    top = 1.0 if multiplied.dtype.kind == "f" else float(np.iinfo(multiplied.dtype).max)
    alpha = multiplied[..., 3:].astype(np.float64)
    colour = np.divide(multiplied[..., :3] * top, alpha, out=np.zeros(multiplied[..., :3].shape), where=alpha > 0)
    if multiplied.dtype.kind != "f":
        colour = np.round(np.minimum(colour, top))
    return np.concatenate([colour.astype(multiplied.dtype), multiplied[..., 3:]], axis=2)


SIGNATURE = b"\x89PNG\r\n\x1a\n"
_BEFORE_DATA, _CRC = 8, 4
_LAST = b"IEND"
_OF_PIXELS = {b"IHDR", b"PLTE", b"tRNS", b"IDAT", _LAST}


def without_chatter(data: UInt8[np.ndarray, " bytes"]) -> UInt8[np.ndarray, " fewer"] | None:
    """Return the PNG chunks that define pixels (PNG specification, third edition, section 5); None if one is missing or damaged.

    Profiles, comments and the like are dropped: they are not used here, and many are malformed. A file that is no PNG, or has none of
    them, is returned as it is.
    """
    if data[: len(SIGNATURE)].tobytes() != SIGNATURE:
        return data
    whole, at, kind = data.data, len(SIGNATURE), b""
    kept: list[bytes | memoryview] = [SIGNATURE]
    while kind != _LAST:
        after = at + _BEFORE_DATA + int.from_bytes(whole[at : at + 4], "big") + _CRC
        if after > len(whole) or at + _BEFORE_DATA > len(whole):
            return None
        kind = bytes(whole[at + 4 : at + _BEFORE_DATA])
        if kind in _OF_PIXELS:
            if zlib.crc32(whole[at + 4 : after - _CRC]) != int.from_bytes(whole[after - _CRC : after], "big"):
                return None
            kept.append(whole[at:after])
        at = after
    return data if sum(map(len, kept)) == len(data) else np.frombuffer(b"".join(kept), np.uint8)


_lock = Lock()
_state = {"inside": 0, "before": 0}


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silence OpenCV's log while a possibly damaged file is decoded.

    The level is shared by all threads: the first in sets it, the last out restores it.
    """
    from cv2.utils import logging

    with _lock:
        if not _state["inside"]:
            _state["before"] = logging.getLogLevel()
            logging.setLogLevel(logging.LOG_LEVEL_SILENT)
        _state["inside"] += 1
    try:
        yield
    finally:
        with _lock:
            _state["inside"] -= 1
            if not _state["inside"]:
                logging.setLogLevel(_state["before"])


Encoding = Literal["srgb", "linear"]

_INTEGER_RANGE = {np.dtype(np.uint8): 255.0, np.dtype(np.uint16): 65535.0}
_SWAPPED_BY_OPENCV = (np.dtype(np.uint8), np.dtype(np.uint16), np.dtype(np.float32))


def stored_pixels(path: Path) -> np.ndarray:
    """Read the stored numbers of a PNG, TIFF, JPEG, WebP, HEIC or HDR file: (H, W) or (H, W, 3 or 4), blue first.

    Raises InputError if the file is empty or damaged.
    """
    import cv2

    data = np.fromfile(path, np.uint8)
    if not data.size:
        raise InputError(f"{path} is empty: copy or render it again")
    if is_heif(path):
        return heif_pixels(path)
    sound = without_chatter(data)
    with quiet_opencv():
        pixels = None if sound is None else cv2.imdecode(sound, cv2.IMREAD_UNCHANGED)
    if pixels is None:
        raise InputError(f"{path} cannot be read as a picture: it is damaged or not what its suffix says")
    return tiff_as_stored(path, pixels) if path.suffix.lower() in TIFF_SUFFIXES else np.asarray(pixels)


def stored_rgb(path: Path) -> Shaped[np.ndarray, "height width channels"]:
    """Read the stored numbers as (H, W, 3 or 4), red first; grey is repeated."""
    import cv2

    pixels = stored_pixels(path)
    if pixels.ndim == 2:
        return np.repeat(pixels[..., None], 3, axis=2)
    if pixels.dtype in _SWAPPED_BY_OPENCV:
        return np.asarray(cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB if pixels.shape[2] == 3 else cv2.COLOR_BGRA2RGBA))
    order = [2, 1, 0] if pixels.shape[2] == 3 else [2, 1, 0, 3]
    return np.ascontiguousarray(pixels[..., order])


def write_stored(path: Path | str, pixels: Shaped[np.ndarray, "height width *channels"]) -> None:
    """Write codes (H, W) or (H, W, 3 or 4), red first, in the format of the suffix. Raises InputError if it cannot hold them."""
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
    """Convert 8 or 16 bit codes to scene-linear Rec.709; alpha, the fourth channel, has no curve.

    path: the file, whose colour profile counts where the encoding is not "linear", and for the error.
    """
    if codes.dtype not in _INTEGER_RANGE:
        raise InputError(f"{path} stores {codes.dtype}: expected 8 or 16 bit integers or float")
    top = np.float32(_INTEGER_RANGE[codes.dtype])
    if encoding != "srgb":
        return codes / top
    colour, profile = codes[..., :3], profile_of(path)
    linear = _looked_up(srgb_to_linear(np.arange(int(top) + 1) / top), colour) if profile is None else _by_profile(profile, colour)
    return linear if codes.shape[2] == 3 else np.dstack([linear, codes[..., 3] / top])


def _by_profile(profile: ColourProfile, codes: Shaped[np.ndarray, "height width 3"]) -> Float32[np.ndarray, "height width 3"]:
    import cv2

    tables = profile.tables(int(_INTEGER_RANGE[codes.dtype]))
    light = (
        cv2.LUT(np.ascontiguousarray(codes), tables[:, None])
        if codes.dtype == np.uint8
        else cv2.merge([np.take(np.ascontiguousarray(tables[:, i]), codes[..., i]) for i in range(3)])
    )
    return np.asarray(cv2.transform(light, profile.rec709_from_rgb.astype(np.float32)))


def _looked_up(
    table: Float32[np.ndarray, " codes"], codes: Shaped[np.ndarray, "height width channels"]
) -> Float32[np.ndarray, "height width channels"]:
    """Return the table's entry of each code; OpenCV's LUT is for 8 bits."""
    import cv2

    return np.asarray(cv2.LUT(np.ascontiguousarray(codes), table)) if codes.dtype == np.uint8 else table[codes]


def codes_of(rgb: Float32[np.ndarray, "height width 3"], dtype: type, encoding: Encoding) -> Shaped[np.ndarray, "height width 3"]:
    """Encode scene-linear light as uint8 or uint16: 0 to 1 spans all codes, the rest is clipped, NaN is 0."""
    return srgb_codes(rgb, dtype) if encoding == "srgb" else even_codes(rgb, dtype)


def even_codes(values: Float[np.ndarray, "*shape"], dtype: type) -> Shaped[np.ndarray, "*shape"]:
    """Encode values at even steps, without a curve."""
    return np.round(np.clip(np.nan_to_num(values), 0, 1) * np.iinfo(dtype).max).astype(dtype)
