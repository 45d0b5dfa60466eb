"""Depth that phones keep in their JPEGs: Google's GDepth, with the sharp original (GImage) and where it was focused (GFocus).

Formats: developers.google.com/depthmap-metadata. RangeInverse: d = far near / (far - n (far - near)), linear in dioptres;
RangeLinear: d = near + n (far - near); n is the number of the map in [0, 1]. Lens Blur has depth to an unknown scale.
They lie in the JPEG's XMP: a packet in the first kilobytes and an extended one in chunks (XMP Specification Part 3, 1.1.3).
"""

import base64
import binascii
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
from jaxtyping import Float32

from mrbokeh.depth.depth_map import DepthMap, without_steps
from mrbokeh.images.color import srgb_to_linear
from mrbokeh.images.exif import stored_orientation, upright
from mrbokeh.system.errors import InputError

_PACKET = b"http://ns.adobe.com/xap/1.0/\0"
_EXTENSION = b"http://ns.adobe.com/xmp/extension/\0"
_HAS_EXTENDED = "{http://ns.adobe.com/xmp/note/}HasExtendedXMP"
_GUID = 32


def read_xmp(path: Path) -> dict[str, str]:
    """Read simple properties by their full name ({namespace}Name); {} if the file is no JPEG or has none.

    Raises InputError where a chunk of the extended packet is missing.
    """
    segments = _app1_segments(path.read_bytes())
    packet = next((each.removeprefix(_PACKET) for each in segments if each.startswith(_PACKET)), None)
    if packet is None:
        return {}
    properties = _properties(packet, path)
    if _HAS_EXTENDED in properties:
        chunks = [each.removeprefix(_EXTENSION) for each in segments if each.startswith(_EXTENSION)]
        properties |= _properties(_reassembled(chunks, properties[_HAS_EXTENDED], path), path)
    return properties


def _app1_segments(data: bytes) -> list[bytes]:
    """Return the contents of the APP1 segments before the picture starts."""
    segments, place = [], 2
    while data[:2] == b"\xff\xd8" and data[place : place + 1] == b"\xff" and place + 4 <= len(data):
        marker, length = data[place + 1], int.from_bytes(data[place + 2 : place + 4], "big")
        if marker == 0xDA or length < 2:
            break
        if marker == 0xE1:
            segments.append(data[place + 4 : place + 2 + length])
        place += 2 + length
    return segments


def _reassembled(chunks: list[bytes], guid: str, path: Path) -> bytes:
    """Join the chunks of an extended packet.

    Each has the digest that names the packet, its full length, its own offset (big-endian) and its part of the packet.
    """
    own = [each for each in chunks if each[:_GUID].decode("ascii", "replace") == guid]
    parts = {int.from_bytes(each[_GUID + 4 : _GUID + 8], "big"): each[_GUID + 8 :] for each in own}
    length = int.from_bytes(own[0][_GUID : _GUID + 4], "big") if own else -1
    packet = bytearray()
    for offset in sorted(parts):
        if offset == len(packet):
            packet += parts[offset]
    if len(packet) != length:
        raise InputError(
            f"{path}: its extended XMP, in which the depth lies, is incomplete ({len(packet)} of {length} bytes): copy it again"
        )
    return bytes(packet)


def _properties(packet: bytes, path: Path) -> dict[str, str]:
    try:
        root = ElementTree.fromstring(packet.strip(b"\0 \r\n\t"))
    except ElementTree.ParseError as error:
        raise InputError(f"{path}: its XMP cannot be read ({error}): copy the file again from the phone") from None
    found = {name: value for element in root.iter() for name, value in element.attrib.items()}
    return found | {
        element.tag: element.text.strip() for element in root.iter() if len(element) == 0 and element.text and element.text.strip()
    }


_DEPTH = "{http://ns.google.com/photos/1.0/depthmap/}"
_IMAGE = "{http://ns.google.com/photos/1.0/image/}"
_FOCUS = "{http://ns.google.com/photos/1.0/focus/}"


@dataclass(frozen=True)
class PhoneFocus:
    """Focus that GFocus states.

    focus_distance_m: in the unit of the depth. blur_at_infinity: RADIUS of the blur at infinity over the longer side of the picture.
    x, y: the place in focus, in [0, 1].
    """

    focus_distance_m: float
    blur_at_infinity: float
    x: float = 0.5
    y: float = 0.5

    def coc_px_per_dioptre(self, width_px: int, height_px: int) -> float:
        """Return c_inf d_f, by which coc = c_inf (1 - d_f / d) grows for each dioptre away from the focus."""
        return 2.0 * self.blur_at_infinity * max(width_px, height_px) * self.focus_distance_m


@dataclass(frozen=True)
class PhonePhoto:
    """Contents of a phone's JPEG, upright as its Exif says.

    depth: at its own size. original_rgb: (H, W, 3) linear, before the phone's own blur, or None. focus: None if not stated.
    """

    depth: DepthMap
    original_rgb: Float32[np.ndarray, "height width 3"] | None
    focus: PhoneFocus | None


def read_phone_photo(path: Path, near_far_m: tuple[float, float] | None = None) -> PhonePhoto | None:
    """Read a phone's depth; None if the file holds no GDepth.

    near_far_m: replaces the file's Near and Far, which often have no unit. Raises InputError if it is damaged or of an unknown format.
    """
    xmp = read_xmp(path) if path.suffix.lower() in (".jpg", ".jpeg") else {}
    if _DEPTH + "Data" not in xmp:
        return None
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
    return PhoneFocus(*numbers)


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
