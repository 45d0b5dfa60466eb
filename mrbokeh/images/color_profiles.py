"""Colour profiles that photographs state: ICC inside JPEG, PNG, TIFF, WebP and HEIC, nclx of HEIC, and Adobe RGB of cameras (DCF 2.0).

Profiles of primaries and curves (ICC.1:2022, 8.3 and 10.6, 10.18) are read, which are those of cameras, phones and screens. Those of
tables (printers, some scanners) are not: the picture is taken for sRGB then, and a line says so.
"""

import logging
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Float64

from mrbokeh.images.color import linear_to_srgb, srgb_to_linear
from mrbokeh.images.exif import TIFF_SUFFIXES, header_of, tiff_tags
from mrbokeh.images.exr_io import BT2020, P3_D65, REC709, rec709_from_chromaticities, rec709_from_matrix
from mrbokeh.images.heif import is_heif, open_heif

_log = logging.getLogger(__name__)

ADOBE_RGB = (0.640, 0.330, 0.210, 0.710, 0.150, 0.060, 0.3127, 0.3290)
"""Primaries and white of Adobe RGB (1998)."""
_ADOBE_GAMMA = 563 / 256

Codes = Float[np.ndarray, " codes"]
Curve = Callable[[Codes], Codes]


@dataclass(frozen=True)
class ColourProfile:
    """Meaning of a picture's codes. curves: of red, green and blue, from codes in [0, 1] to linear light."""

    name: str
    rec709_from_rgb: Float64[np.ndarray, "3 3"]
    curves: tuple[Curve, Curve, Curve]

    def tables(self, top: int) -> Float32[np.ndarray, "codes 3"]:
        """Return the light of all codes from 0 to top."""
        codes = np.arange(top + 1) / top
        return np.stack([np.asarray(curve(codes), np.float32) for curve in self.curves], axis=1)

    @property
    def is_srgb(self) -> bool:
        """Return whether it is sRGB but for rounding: makers round its numbers in many ways, and its own formula is exact."""
        codes = self.tables(_PROBES)
        same_curve = np.abs(linear_to_srgb(np.clip(codes, 0.0, 1.0)) - np.arange(_PROBES + 1)[:, None] / _PROBES).max() < 1.0 / 255.0
        return bool(same_curve) and bool(np.abs(self.rec709_from_rgb - np.eye(3)).max() < _SAME_MATRIX)


_PROBES, _SAME_MATRIX = 255, 2e-3


class UnreadableProfileError(ValueError):
    """A profile says in a way that is not read, or in none, what codes mean. The message completes "its colour profile ..."."""


def profile_of(path: Path) -> ColourProfile | None:
    """Return the profile of a picture; None is sRGB, stated, not stated, or taken with one line where the profile cannot be read."""
    try:
        return _stated(path)
    except UnreadableProfileError as error:
        _warn(f"{path}: its colour profile {error}; it is taken for sRGB")
        return None


@lru_cache(maxsize=256)
def _warn(text: str) -> None:
    """Say a line once, although a picture is read several times."""
    _log.warning(text)


def _stated(path: Path) -> ColourProfile | None:
    suffix = path.suffix.lower()
    if is_heif(path):
        info = open_heif(path).info
        if info.get("icc_profile"):
            return parsed_icc(bytes(info["icc_profile"]))
        return nclx_profile(info["nclx_profile"]) if info.get("nclx_profile") else None
    if suffix in TIFF_SUFFIXES:
        stored = tiff_tags(path).get(_TIFF_ICC)
        return parsed_icc(bytes(stored)) if stored else None
    data, is_adobe = _by_pillow(path)
    if data:
        return parsed_icc(data)
    return _adobe_rgb() if is_adobe else None


_TIFF_ICC = 34675
_INTEROP_IFD, _INTEROP_INDEX, _OPTION_FILE = 0xA005, 1, "R03"


def _by_pillow(path: Path) -> tuple[bytes, bool]:
    """Return the ICC profile of a JPEG, PNG or WebP, and whether Exif calls it an option file, which DCF 2.0 defines as Adobe RGB."""
    from PIL import Image

    try:
        with header_of(path) as picture:
            if data := picture.info.get("icc_profile"):
                return bytes(data), False
            # Not picture.getexif(), which decodes the whole of a PNG to look for the tag behind its pixels.
            index = Image.Image.getexif(picture).get_ifd(_INTEROP_IFD).get(_INTEROP_INDEX) if picture.format in ("JPEG", "MPO") else None
            return b"", isinstance(index, str) and index.strip("\0 ") == _OPTION_FILE
    except (OSError, SyntaxError, ValueError):
        return b"", False


def _adobe_rgb() -> ColourProfile:
    matrix = rec709_from_chromaticities(ADOBE_RGB)
    assert matrix is not None
    return ColourProfile("Adobe RGB by Exif", matrix, (_power(_ADOBE_GAMMA),) * 3)


_PRIMARIES = {1: REC709, 2: REC709, 9: BT2020, 12: P3_D65}
_CURVES: Mapping[int, Curve] = {
    **dict.fromkeys((1, 2, 6, 13, 14, 15), lambda codes: srgb_to_linear(codes)),
    4: lambda codes: codes**2.2,
    8: lambda codes: codes,
}
"""Transfers of ITU-T H.273. Stills with BT.709's curve are meant for screens as those with sRGB's are, and decoded alike everywhere."""
_HDR = {16: "PQ", 18: "HLG"}


def nclx_profile(stated: Mapping[str, Any]) -> ColourProfile | None:
    """Return the profile of HEIC's coded colours (ISO/IEC 23091-2); None is sRGB. Raises UnreadableProfileError for HDR and odd ones."""
    primaries, transfer = int(stated.get("color_primaries", 2)), int(stated.get("transfer_characteristics", 2))
    if transfer in _HDR:
        raise UnreadableProfileError(f"is HDR ({_HDR[transfer]}), which is not read of stills: export it as SDR, or as EXR")
    if primaries not in _PRIMARIES or transfer not in _CURVES:
        raise UnreadableProfileError(f"is not known (nclx: primaries {primaries}, transfer {transfer})")
    matrix = rec709_from_chromaticities(_PRIMARIES[primaries])
    assert matrix is not None
    profile = ColourProfile(f"nclx {primaries}/{transfer}", matrix, (_CURVES[transfer],) * 3)
    return None if profile.is_srgb else profile


_HEADER_BYTES, _ENTRY_BYTES, _MOST_TAGS = 128, 12, 200


@lru_cache(maxsize=16)
def parsed_icc(data: bytes) -> ColourProfile | None:
    """Parse an ICC profile; None is sRGB. Raises UnreadableProfileError where it is damaged, or not of primaries and curves."""
    try:
        profile = _parsed(data)
    except (struct.error, IndexError, KeyError, ZeroDivisionError, OverflowError):
        raise UnreadableProfileError("is damaged") from None
    return None if profile.is_srgb else profile


def _parsed(data: bytes) -> ColourProfile:
    tags, space = _tags(data), data[16:20]
    name = _described(tags.get(b"desc", b""))
    if space == b"GRAY" and b"kTRC" in tags:
        return ColourProfile(name, np.eye(3), (_curve(tags[b"kTRC"]),) * 3)
    if space != b"RGB " or data[20:24] != b"XYZ " or not {b"rXYZ", b"gXYZ", b"bXYZ", b"rTRC", b"gTRC", b"bTRC"} <= tags.keys():
        kind = space.decode("ascii", "replace").strip()
        raise UnreadableProfileError(f"({name}, {kind}) is not one of RGB primaries and curves: convert the picture to sRGB")
    XYZ_from_rgb = np.array([struct.unpack_from(">3i", tags[each], 8) for each in (b"rXYZ", b"gXYZ", b"bXYZ")]).T / 65536.0
    matrix = rec709_from_matrix(XYZ_from_rgb) if np.linalg.matrix_rank(XYZ_from_rgb) == 3 else None
    if matrix is None:
        raise UnreadableProfileError(f"({name}) has primaries that span no colours")
    return ColourProfile(name, matrix, (_curve(tags[b"rTRC"]), _curve(tags[b"gTRC"]), _curve(tags[b"bTRC"])))


def _tags(data: bytes) -> dict[bytes, bytes]:
    if data[36:40] != b"acsp":
        raise UnreadableProfileError("is damaged")
    (count,) = struct.unpack_from(">I", data, _HEADER_BYTES)
    found = {}
    for index in range(min(count, _MOST_TAGS)):
        name, offset, size = struct.unpack_from(">4sII", data, _HEADER_BYTES + 4 + _ENTRY_BYTES * index)
        found[name] = data[offset : offset + size]
    return found


def _described(tag: bytes) -> str:
    """Return the name of a profile, in ASCII (version 2) or UTF-16 (version 4)."""
    if tag[:4] == b"desc":
        return tag[12 : 12 + int.from_bytes(tag[8:12], "big")].decode("ascii", "replace").strip("\0 ")
    if tag[:4] == b"mluc":
        length, offset = struct.unpack_from(">II", tag, 20)
        return tag[offset : offset + length].decode("utf-16-be", "replace").strip("\0 ")
    return "without a name"


_PARAMETERS = (1, 3, 4, 5, 7)


def _curve(tag: bytes) -> Curve:
    """Parse a curve: a table, one gamma or none (curv), or the formulas of parametricCurveType (para)."""
    if tag[:4] == b"curv":
        (count,) = struct.unpack_from(">I", tag, 8)
        if count == 0:
            return _power(1.0)
        values = np.array(struct.unpack_from(f">{count}H", tag, 12), np.float64)
        return _power(values[0] / 256.0) if count == 1 else _table(values / 65535.0)
    (kind,) = struct.unpack_from(">H", tag, 8)
    if tag[:4] != b"para" or kind >= len(_PARAMETERS):
        raise UnreadableProfileError("has curves of an unknown kind")
    numbers = [each / 65536.0 for each in struct.unpack_from(f">{_PARAMETERS[kind]}i", tag, 12)]
    return _formula(kind, numbers)


def _power(gamma: float) -> Curve:
    return lambda codes: codes**gamma


def _table(values: Float64[np.ndarray, " entries"]) -> Curve:
    places = np.linspace(0.0, 1.0, len(values))
    return lambda codes: np.interp(codes, places, values)


def _formula(kind: int, numbers: list[float]) -> Curve:
    """Return (a x + b)^g + e from d on, and c x + f before, as ICC.1:2022, table 68, has them with fewer numbers."""
    gamma, *rest = numbers
    a, b, c, d, e, f = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
    if kind in (1, 2):
        a, b = rest[:2]
        e = f = rest[2] if kind == 2 else 0.0
        d = -b / a
    elif kind >= 3:
        a, b, c, d = rest[:4]
        e, f = rest[4:] if kind == 4 else (0.0, 0.0)
    return lambda codes: np.where(codes >= d, np.maximum(a * codes + b, 0.0) ** gamma + e, c * codes + f)
