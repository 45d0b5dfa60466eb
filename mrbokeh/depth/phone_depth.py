"""Depth that phones keep in their photographs: Google's in JPEG and Apple's in HEIC and JPEG.

Google's GDepth comes with the sharp original (GImage) and where it was focused (GFocus), all in the XMP of the JPEG:
developers.google.com/depthmap-metadata. RangeInverse: d = far near / (far - n (far - near)), linear in dioptres; RangeLinear: d = near +
n (far - near); n is the number of the map in [0, 1]. Lens Blur has depth to an unknown scale.

Apple's depth is an auxiliary picture, in HEIC or behind a JPEG, whose own XMP says what its numbers mean: codes from IntMinValue to
IntMaxValue are even from FloatMinValue to FloatMaxValue, in 1/m (disparity) or m (depth). Its Accuracy is "absolute", or "relative" where
the phone knows what is nearer, but not how many metres (AVDepthData, developer.apple.com). The file does not tell where it was focused; the
depth does, of what takes up much of the subject area. Where Exif calls the picture a portrait (CustomRendered 7 or 8), the phone has
blurred it, which is taken for the blur of full frame at SimulatedAperture. Of an iPhone 13 Pro's portrait at f/2.8, edges in front of
the focus have 23 to 32 px where that gives 32, and edges far behind it 43 to 49 px where it gives 24 to 28.
"""

import base64
import binascii
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mrbokeh.depth.depth_map import DepthMap, without_steps
from mrbokeh.images.color import srgb_to_linear
from mrbokeh.images.exif import AS_STORED, exif_and_size, stored_orientation, upright
from mrbokeh.images.heif import is_heif, open_heif, plane_of
from mrbokeh.images.xmp import further_jpegs, jpeg_xmp, xmp_properties
from mrbokeh.system.errors import InputError

_DEPTH = "{http://ns.google.com/photos/1.0/depthmap/}"
_IMAGE = "{http://ns.google.com/photos/1.0/image/}"
_FOCUS = "{http://ns.google.com/photos/1.0/focus/}"


@dataclass(frozen=True)
class PhoneFocus:
    """Focus of a phone's photograph, as GFocus states it or guessed.

    focus_distance_m: in the unit of the depth. blur_at_infinity: RADIUS of the blur at infinity over the longer side of the picture; None
    if the phone put none on. x, y: the place in focus, in [0, 1]. note: what of it is guessed, for people.
    """

    focus_distance_m: float
    blur_at_infinity: float | None
    x: float = 0.5
    y: float = 0.5
    note: str = ""

    def coc_px_per_dioptre(self, width_px: int, height_px: int) -> float:
        """Return c_inf d_f, by which coc = c_inf (1 - d_f / d) grows for each dioptre away from the focus. Only where the phone blurred."""
        assert self.blur_at_infinity is not None
        return 2.0 * self.blur_at_infinity * max(width_px, height_px) * self.focus_distance_m


@dataclass(frozen=True)
class PhonePhoto:
    """Contents of a phone's photograph, upright as its Exif says.

    depth: at its own size. original_rgb: (H, W, 3) linear, before the phone's own blur, or None. focus: None if not stated.
    """

    depth: DepthMap
    original_rgb: Float32[np.ndarray, "height width 3"] | None
    focus: PhoneFocus | None


def read_phone_photo(path: Path, near_far_m: tuple[float, float] | None = None) -> PhonePhoto | None:
    """Read a phone's depth; None if the file holds neither Google's nor Apple's.

    near_far_m: replaces the file's nearest and farthest distance, which often have no unit. Raises InputError if it is damaged or of an
    unknown format.
    """
    if is_heif(path):
        return _apple_photo(_heic_depth(path), path, near_far_m)
    data = path.read_bytes() if path.suffix.lower() in (".jpg", ".jpeg") else b""
    xmp = jpeg_xmp(data, path)
    if _DEPTH + "Data" not in xmp:
        return _apple_photo(_jpeg_depth(data, path), path, near_far_m)
    orientation, original = stored_orientation(path), xmp.get(_IMAGE + "Data")
    stored = _depth(xmp, path, near_far_m)
    depth = replace(stored, depth_m=upright(stored.depth_m, orientation), valid=upright(stored.valid, orientation))
    if original is None:
        return PhonePhoto(depth, None, _focus(xmp))
    return PhonePhoto(depth, srgb_to_linear(upright(_decoded(original, path)[..., :3], orientation)), _focus(xmp))


def _depth(xmp: Mapping[str, str], path: Path, near_far_m: tuple[float, float] | None) -> DepthMap:
    kind = xmp.get(_DEPTH + "Format", "")
    if kind not in ("RangeInverse", "RangeLinear"):
        raise InputError(f"{path}: expected GDepth:Format RangeInverse or RangeLinear, got {kind!r}")
    try:
        near, far = near_far_m or (float(xmp[_DEPTH + "Near"]), float(xmp[_DEPTH + "Far"]))
    except (KeyError, ValueError):
        raise InputError(f"{path}: GDepth:Near and Far are missing: state them with --disparity NEAR:FAR in metres") from None
    if kind == "RangeLinear" and not np.isfinite(far):
        raise InputError(f"{path}: its depth is linear in metres, so that FAR cannot be infinite: give a distance")
    level = without_steps(_decoded(xmp[_DEPTH + "Data"], path)[..., 0], 256)
    units = xmp.get(_DEPTH + "Units", "") or (
        "metres as stated" if near_far_m else "no unit, taken as metres; --disparity NEAR:FAR says better"
    )
    note = f"GDepth of the phone, {near:g} to {far:g} ({units})"
    everywhere = np.ones(level.shape, bool)
    if kind == "RangeInverse":
        return DepthMap.of_dioptres((1.0 - level) / near + level / far, everywhere, note)
    return DepthMap((near + level * (far - near)).astype(np.float32), everywhere, note)


def _focus(xmp: Mapping[str, str]) -> PhoneFocus | None:
    if _FOCUS + "FocalDistance" not in xmp or _FOCUS + "BlurAtInfinity" not in xmp:
        return None
    numbers = (float(xmp.get(_FOCUS + name, 0.5)) for name in ("FocalDistance", "BlurAtInfinity", "FocalPointX", "FocalPointY"))
    return PhoneFocus(next(numbers), next(numbers), next(numbers), next(numbers))


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


_PIXELS, _APPLE, _BLUR = (f"{{http://ns.apple.com/{each}/1.0/}}" for each in ("pixeldatainfo", "depthData", "depthBlurEffect"))
_EXIF_IFD, _SUBJECT_AREA, _CUSTOM_RENDERED, _FILM_FOCAL_LENGTH = 0x8769, 0x9214, 0xA401, 0xA405
_PORTRAITS = (7, 8)
_FULL_FRAME_DIAGONAL_MM = float(np.hypot(36.0, 24.0))
_XMP_PACKET = re.compile(rb"<x:xmpmeta.*?</x:xmpmeta>", re.DOTALL)


@dataclass(frozen=True)
class AppleDepth:
    """Auxiliary picture of disparity or depth as it is stored. codes: its numbers. xmp: its own properties."""

    codes: Float32[np.ndarray, "height width"]
    xmp: Mapping[str, str]


def _heic_depth(path: Path) -> AppleDepth | None:
    """Return the depth of a HEIC, upright; what its numbers mean stands in a packet of XMP, else in a message of HEVC."""
    pictures = open_heif(path).info.get("depth_images") or []
    if not pictures:
        return None
    packets = (xmp_properties(each, path) for each in _XMP_PACKET.findall(path.read_bytes()) if b"AuxiliaryImageType" in each)
    xmp = next((each for each in packets if _is_depth(each)), None)
    try:
        codes = plane_of(pictures[0])[..., 0].astype(np.float32)
    except (ValueError, EOFError, SyntaxError, RuntimeError, OSError):
        raise InputError(f"{path}: its depth cannot be decoded: copy the file again from the phone") from None
    return AppleDepth(codes, _of_message(pictures[0].info.get("metadata") or {}) if xmp is None else xmp)


_UNIFORM_DISPARITY, _UNIFORM_INVERSE_DEPTH = 1, 0


def _of_message(metadata: Mapping[str, Any]) -> dict[str, str]:
    """Return the range of HEVC's message on depth (ITU-T H.265, G.14.2.3) under the names that XMP has for it."""
    if metadata.get("representation_type") not in (_UNIFORM_DISPARITY, _UNIFORM_INVERSE_DEPTH) or not metadata.get("d_max"):
        return {}
    low, high = metadata.get("d_min", 0.0), metadata["d_max"]
    return {_PIXELS + "AuxiliaryImageType": "disparity", _PIXELS + "FloatMinValue": str(low), _PIXELS + "FloatMaxValue": str(high)}


def _jpeg_depth(data: bytes, path: Path) -> AppleDepth | None:
    """Return the depth behind a JPEG, as it is stored."""
    import cv2

    for each in further_jpegs(data):
        xmp = jpeg_xmp(each, path)
        if not _is_depth(xmp):
            continue
        codes = cv2.imdecode(np.frombuffer(each, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        if codes is None:
            raise InputError(f"{path}: its depth cannot be decoded: copy the file again from the phone")
        return AppleDepth(codes.astype(np.float32), xmp)
    return None


def _is_depth(xmp: Mapping[str, str]) -> bool:
    return xmp.get(_PIXELS + "AuxiliaryImageType", "").lower() in ("disparity", "depth")


def _apple_photo(found: AppleDepth | None, path: Path, near_far_m: tuple[float, float] | None) -> PhonePhoto | None:
    if found is None:
        return None
    depth, orientation = apple_depth_map(found, path, near_far_m), AS_STORED if is_heif(path) else stored_orientation(path)
    focus = _apple_focus(depth, found, path)
    return PhonePhoto(replace(depth, depth_m=upright(depth.depth_m, orientation), valid=upright(depth.valid, orientation)), None, focus)


def apple_depth_map(found: AppleDepth, path: Path, near_far_m: tuple[float, float] | None = None) -> DepthMap:
    """Convert Apple's codes to depth. near_far_m: replaces the range of the file. Raises InputError where that is not stated."""
    is_disparity = found.xmp.get(_PIXELS + "AuxiliaryImageType", "disparity").lower() == "disparity"
    try:
        least, most = (float(found.xmp.get(_PIXELS + name, default)) for name, default in (("IntMinValue", 0), ("IntMaxValue", 255)))
        stated = (
            tuple(float(found.xmp[_PIXELS + name]) for name in ("FloatMinValue", "FloatMaxValue")) if near_far_m is None else near_far_m
        )
    except (KeyError, ValueError):
        raise InputError(f"{path}: its depth does not say what its numbers mean: state it with --disparity NEAR:FAR in metres") from None
    if not (np.isfinite(stated).all() or near_far_m) or not most > least or not stated[0] <= stated[1]:
        raise InputError(
            f"{path}: its depth goes from {stated[0]:g} to {stated[1]:g}, which is no range: state --disparity NEAR:FAR in metres"
        )
    level = without_steps(np.clip((found.codes - np.float32(least)) / np.float32(most - least), 0.0, 1.0), int(most - least) + 1)
    everywhere = np.ones(level.shape, bool)
    if not is_disparity:
        near, far = stated
        return DepthMap(
            np.maximum(near + level * (far - near), _NEAREST_M).astype(np.float32), everywhere, _apple_note(found, stated, near_far_m)
        )
    low, high = (1.0 / stated[1], 1.0 / stated[0]) if near_far_m else stated
    ends = (1.0 / high if high > 0 else np.inf, 1.0 / low if low > 0 else np.inf)
    return DepthMap.of_dioptres(low + level * (high - low), everywhere, _apple_note(found, ends, near_far_m))


_NEAREST_M = 0.01


def _apple_note(found: AppleDepth, ends_m: tuple[float, ...], near_far_m: tuple[float, float] | None) -> str:
    accuracy = found.xmp.get(_APPLE + "Accuracy", "")
    units = (
        "metres, as the phone measured them"
        if accuracy == "absolute"
        else (f"{accuracy or 'unknown'} accuracy: what is nearer is known, metres are guessed; --disparity NEAR:FAR says better")
    )
    return f"portrait depth of the phone, {ends_m[0]:.3g} to {ends_m[1]:.3g} m ({'metres as stated' if near_far_m else units})"


_SUBJECT_SHARE = 0.25


def _apple_focus(depth: DepthMap, found: AppleDepth, path: Path) -> PhoneFocus | None:
    """Guess the focus: the nearest that takes up a quarter of the middle of the subject area; and return the blur of a portrait."""
    tags, size_px = _facts(path)
    rows, columns = depth.depth_m.shape
    x, y, across, down = _subject_area(tags.get(_SUBJECT_AREA), size_px)
    top, left = int((y - down / 4) * rows), int((x - across / 4) * columns)
    middle = depth.dioptres[
        max(top, 0) : max(int((y + down / 4) * rows), top + 1), max(left, 0) : max(int((x + across / 4) * columns), left + 1)
    ]
    dioptres = float(np.quantile(middle, 1.0 - _SUBJECT_SHARE)) if middle.size else 0.0
    if dioptres <= 0.0:
        return None
    note = f"its focus is guessed from what is near in the middle of the picture, {1.0 / dioptres:.3g} m; --focus-at X,Y says better"
    px_per_dioptre = _portrait_blur(found, tags, size_px)
    if px_per_dioptre is None:
        return PhoneFocus(focus_distance_m=1.0 / dioptres, blur_at_infinity=None, x=x, y=y, note=note)
    note += f"; its blur is taken for that of full frame at f/{float(found.xmp[_BLUR + 'SimulatedAperture']):g}, as its file tells"
    blur_at_infinity = px_per_dioptre * dioptres / (2.0 * max(size_px))
    return PhoneFocus(focus_distance_m=1.0 / dioptres, blur_at_infinity=blur_at_infinity, x=x, y=y, note=note)


def _facts(path: Path) -> tuple[dict[int, Any], tuple[int, int]]:
    exif = exif_and_size(path)
    return ({}, (0, 0)) if exif is None else (dict(exif[0].get_ifd(_EXIF_IFD)), exif[1])


def _subject_area(stated: Any, size_px: tuple[int, int]) -> tuple[float, float, float, float]:
    """Return the middle and the size of the subject area as shares of the picture; of a picture that was turned since it is unknown."""
    width_px, height_px = size_px
    if not isinstance(stated, tuple) or len(stated) != 4 or stated[0] >= width_px or stated[1] >= height_px or height_px > width_px:
        return 0.5, 0.5, 0.5, 0.5
    return stated[0] / width_px, stated[1] / height_px, stated[2] / width_px, stated[3] / height_px


def _portrait_blur(found: AppleDepth, tags: Mapping[int, Any], size_px: tuple[int, int]) -> float | None:
    """Return the diameter in pixels by which the phone blurred for each dioptre from the focus; None if it did not, or does not say so.

    An opening of f / N, with f the focal length for 35 mm film, which counts diagonals.
    """
    try:
        f_number, focal_mm = float(found.xmp[_BLUR + "SimulatedAperture"]), float(tags[_FILM_FOCAL_LENGTH])
    except (KeyError, ValueError, TypeError):
        return None
    if tags.get(_CUSTOM_RENDERED) not in _PORTRAITS or not f_number > 0 or not focal_mm > 0:
        return None
    focal_px = focal_mm / _FULL_FRAME_DIAGONAL_MM * float(np.hypot(*size_px))
    return focal_mm / 1000.0 / f_number * focal_px
