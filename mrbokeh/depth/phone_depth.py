"""Depth that phones keep in their photographs: Google's in JPEG, and Apple's in HEIC and JPEG with the blur of its portraits.

Google's GDepth lies with the sharp original (GImage) and where it was focused (GFocus) in the file's XMP
(developers.google.com/depthmap-metadata). RangeInverse: d = far near / (far - n (far - near)), linear in dioptres; RangeLinear: d = near +
n (far - near); n is the number of the map in [0, 1]. Lens Blur has depth to an unknown scale: where its nearest would be farther than
_FARTHEST_NEAR_M it is put at a metre.

Apple's depth is an auxiliary picture, in HEIC or behind a JPEG, whose own XMP says what its numbers mean: codes from IntMinValue to
IntMaxValue are even from FloatMinValue to FloatMaxValue, in 1/m (disparity) or m (depth). Its Accuracy is "absolute", or "relative" where
the phone knows what is nearer, but not how many metres (AVDepthData, developer.apple.com), which the range of its focus tells where its
maker note has that. The file does not tell at which place it was focused; the depth does, of what takes up much of the subject area.
Where Exif calls the picture a portrait (CustomRendered 7 or 8), the phone has blurred it, which is taken for the blur of full frame at
SimulatedAperture. Of an iPhone 13 Pro's portrait at f/2.8, edges in front of the focus have 23 to 32 px where that gives 32, and edges
far behind it 43 to 49 px where it gives 24 to 28.
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
from mrbokeh.depth.phone_photo import PhoneFocus, PhonePhoto
from mrbokeh.images.apple_notes import apple_notes
from mrbokeh.images.color import srgb_to_linear
from mrbokeh.images.exif import (
    AS_STORED,
    exif_and_size,
    known_orientation,
    quarter_turns,
    stored_orientation,
    upright,
    upright_place,
)
from mrbokeh.images.heif import is_heif, open_heif, plane_of
from mrbokeh.images.xmp import further_jpegs, jpeg_xmp, xmp_properties
from mrbokeh.system.errors import InputError

_PIXELS, _APPLE, _BLUR = (f"{{http://ns.apple.com/{each}/1.0/}}" for each in ("pixeldatainfo", "depthData", "depthBlurEffect"))
_ORIENTATION, _EXIF_IFD, _SUBJECT_AREA, _CUSTOM_RENDERED, _FILM_FOCAL_LENGTH = 0x0112, 0x8769, 0x9214, 0xA401, 0xA405
_PORTRAITS = (7, 8)
_FULL_FRAME_DIAGONAL_MM = float(np.hypot(36.0, 24.0))
_XMP_PACKET = re.compile(rb"<x:xmpmeta.*?</x:xmpmeta>", re.DOTALL)
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


def apple_photo(data: bytes, path: Path, near_far_m: tuple[float, float] | None) -> PhonePhoto | None:
    """Return the depth of a HEIC, or of a JPEG whose bytes are data; None without one. near_far_m: replaces the range of the file."""
    found = _heic_depth(path) if is_heif(path) else _jpeg_depth(data, path)
    if found is None:
        return None
    stored, orientation = apple_depth_map(found, path, near_far_m), AS_STORED if is_heif(path) else stored_orientation(path)
    depth = replace(stored, depth_m=upright(stored.depth_m, orientation), valid=upright(stored.valid, orientation))
    focus = _apple_focus(depth, found, path)
    if focus is not None and near_far_m is None and found.xmp.get(_APPLE + "Accuracy", "") != "absolute":
        depth, focus = _in_metres(depth, focus, path)
    return PhonePhoto(depth, None, focus)


def _in_metres(depth: DepthMap, focus: PhoneFocus, path: Path) -> tuple[DepthMap, PhoneFocus]:
    """Return a relative depth in which the focus lies as far away as the phone's maker note tells, and that focus; else both as they are.

    The blur in pixels stays.
    """
    note = _facts(path)[0].get(_MAKER_NOTE)
    stated_m = apple_notes(note).focus_distance_m if isinstance(note, bytes) else None
    if stated_m is None:
        return depth, focus
    metres = (depth.depth_m * np.float32(stated_m / focus.focus_distance_m)).astype(np.float32)
    told = f"portrait depth of the phone (metres so that its focus is {stated_m:.2g} m away, as the file tells)"
    return replace(depth, depth_m=metres, note=told), replace(focus, focus_distance_m=stated_m, note="")


_MAKER_NOTE = 0x927C


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
        if not np.isfinite(far):
            raise InputError(f"{path}: its depth is linear in metres, so that FAR cannot be infinite: give a distance")
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
    """Guess the focus: the nearest that takes up a quarter of the middle of the subject area; and return the blur of a portrait.

    depth: upright.
    """
    tags, size_px, orientation = _facts(path)
    rows, columns = depth.depth_m.shape
    x, y, across, down = _subject_area(tags.get(_SUBJECT_AREA), size_px, orientation)
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
        return PhoneFocus(1.0 / dioptres, None, note)
    f_number = float(found.xmp[_BLUR + "SimulatedAperture"])
    blur_note = f"its blur is taken for that of full frame at f/{f_number:g}, as its file tells"
    return PhoneFocus(1.0 / dioptres, px_per_dioptre * dioptres / (2.0 * max(size_px)), note, blur_note=blur_note, f_number=f_number)


def _facts(path: Path) -> tuple[dict[int, Any], tuple[int, int], int]:
    """Return the tags of Exif's own directory, and width, height and orientation of the picture as the camera stored it."""
    found = exif_and_size(path)
    if found is None:
        return {}, (0, 0), AS_STORED
    exif, size_px = found
    orientation = known_orientation(exif.get(_ORIENTATION))
    turned = is_heif(path) and quarter_turns(orientation) % 2 == 1  # HEIC is decoded upright
    return dict(exif.get_ifd(_EXIF_IFD)), size_px[::-1] if turned else size_px, orientation


def _subject_area(stated: Any, size_px: tuple[int, int], orientation: int) -> tuple[float, float, float, float]:
    """Return the middle and the size of the subject area as shares of the upright picture.

    stated: Exif's, in the picture as it is stored. Of one that was turned since, which is higher than wide as no camera stores it, it is
    unknown.
    """
    width_px, height_px = size_px
    if not isinstance(stated, tuple) or len(stated) != 4 or stated[0] >= width_px or stated[1] >= height_px or height_px > width_px:
        return 0.5, 0.5, 0.5, 0.5
    x, y = upright_place(stated[0] / width_px, stated[1] / height_px, orientation)
    across, down = stated[2] / width_px, stated[3] / height_px
    return (x, y, down, across) if quarter_turns(orientation) % 2 else (x, y, across, down)


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
