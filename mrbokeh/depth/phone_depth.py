"""Depth that phones keep in their photographs: Google's in JPEG, which is read here, and Apple's in HEIC and JPEG (`apple_depth`).

Google's GDepth lies with the sharp original (GImage) and where it was focused (GFocus) in the file's XMP
(developers.google.com/depthmap-metadata). RangeInverse: d = far near / (far - n (far - near)), linear in dioptres; RangeLinear: d = near +
n (far - near); n is the number of the map in [0, 1]. Lens Blur has depth to an unknown scale: where its nearest would be farther than
_FARTHEST_NEAR_M it is put at a metre.
"""

import base64
import binascii
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.depth.apple_depth import apple_photo
from mrbokeh.depth.depth_map import DepthMap, without_steps
from mrbokeh.depth.phone_photo import PhoneFocus, PhonePhoto
from mrbokeh.images.color import srgb_to_linear
from mrbokeh.images.exif import stored_orientation, upright
from mrbokeh.images.heif import is_heif
from mrbokeh.images.xmp import jpeg_xmp
from mrbokeh.system.errors import InputError

_DEPTH = "{http://ns.google.com/photos/1.0/depthmap/}"
_IMAGE = "{http://ns.google.com/photos/1.0/image/}"
_FOCUS = "{http://ns.google.com/photos/1.0/focus/}"
_FARTHEST_NEAR_M = 3.0


def read_phone_photo(path: Path, near_far_m: tuple[float, float] | None = None) -> PhonePhoto | None:
    """Read a phone's depth; None if the file holds neither Google's nor Apple's.

    near_far_m: replaces the file's nearest and farthest distance, which often have no unit. Raises InputError if it is damaged or of an
    unknown format.
    """
    if is_heif(path):
        return apple_photo(b"", path, near_far_m)
    data = path.read_bytes() if path.suffix.lower() in (".jpg", ".jpeg") else b""
    return google_photo(jpeg_xmp(data, path), path, near_far_m) or apple_photo(data, path, near_far_m)


def google_photo(xmp: Mapping[str, str], path: Path, near_far_m: tuple[float, float] | None) -> PhonePhoto | None:
    """Return the depth that a JPEG's XMP holds; None if it holds none. near_far_m: replaces the range of the file."""
    if _DEPTH + "Data" not in xmp:
        return None
    orientation, original = stored_orientation(path), xmp.get(_IMAGE + "Data")
    has_unit = near_far_m is not None or bool(xmp.get(_DEPTH + "Units"))
    near, far = near_far_m or _near_and_far(xmp, path)
    scale = 1.0 if has_unit or near <= _FARTHEST_NEAR_M else 1.0 / near
    units = (
        "metres as stated"
        if near_far_m
        else xmp.get(_DEPTH + "Units") or "no unit, its metres are guessed; --disparity NEAR:FAR says better"
    )
    stored = _depth(xmp, path, (scale * near, scale * far), units)
    depth = replace(stored, depth_m=upright(stored.depth_m, orientation), valid=upright(stored.valid, orientation))
    sharp_rgb = None if original is None else srgb_to_linear(upright(_decoded(original, path)[..., :3], orientation))
    return PhonePhoto(depth, sharp_rgb, _focus(xmp, scale), has_unit)


def _near_and_far(xmp: Mapping[str, str], path: Path) -> tuple[float, float]:
    try:
        return float(xmp[_DEPTH + "Near"]), float(xmp[_DEPTH + "Far"])
    except (KeyError, ValueError):
        raise InputError(f"{path}: GDepth:Near and Far are missing: state them with --disparity NEAR:FAR in metres") from None


def _depth(xmp: Mapping[str, str], path: Path, near_far_m: tuple[float, float], units: str) -> DepthMap:
    (near, far), kind = near_far_m, xmp.get(_DEPTH + "Format", "")
    if kind not in ("RangeInverse", "RangeLinear"):
        raise InputError(f"{path}: expected GDepth:Format RangeInverse or RangeLinear, got {kind!r}")
    if kind == "RangeLinear" and not np.isfinite(far):
        raise InputError(f"{path}: its depth is linear in metres, so that FAR cannot be infinite: give a distance")
    level = without_steps(_decoded(xmp[_DEPTH + "Data"], path)[..., 0], 256)
    note = f"GDepth of the phone, {near:.4g} to {far:.4g} ({units})"
    everywhere = np.ones(level.shape, bool)
    if kind == "RangeInverse":
        return DepthMap.of_dioptres((1.0 - level) / near + level / far, everywhere, note)
    return DepthMap((near + level * (far - near)).astype(np.float32), everywhere, note)


def _focus(xmp: Mapping[str, str], scale: float) -> PhoneFocus | None:
    if _FOCUS + "FocalDistance" not in xmp or _FOCUS + "BlurAtInfinity" not in xmp:
        return None
    return PhoneFocus(scale * float(xmp[_FOCUS + "FocalDistance"]), float(xmp[_FOCUS + "BlurAtInfinity"]))


def _decoded(text: str, path: Path) -> Float32[np.ndarray, "height width channels"]:
    """Decode a picture in base64 to its codes in [0, 1], RGB."""
    import cv2

    try:
        data = np.frombuffer(base64.b64decode(text, validate=False), np.uint8)
    except (binascii.Error, ValueError):
        data = np.empty(0, np.uint8)
    pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if pixels is None:
        raise InputError(f"{path}: a picture inside its XMP cannot be decoded: copy the file again from the phone")
    codes = (np.asarray(pixels) / (65535.0 if pixels.dtype == np.uint16 else 255.0)).astype(np.float32)
    return codes[..., None] if codes.ndim == 2 else np.ascontiguousarray(codes[..., [2, 1, 0]])
