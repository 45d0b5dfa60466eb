"""Files of a merged stack: the all-in-focus picture as TIFF, PNG and, for RAW, DNG; its depth in colours; changed places of depth.exr.

PNG, TIFF and depth stand upright as the cameras' orientation says; DNG says so in its header, and the EXR stay as the sensor saw them.
"""

import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, UInt8, UInt16

from mrbokeh.figures.stack_pictures import depth_codes, orientation_of, write_upright_png
from mrbokeh.images.camera_rgb import Matrix3x3
from mrbokeh.images.color import rec709_from_XYZ
from mrbokeh.images.exif import upright
from mrbokeh.images.picture_codec import codes_of, even_codes, write_stored
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.stacks.guessed_metres import POSITION, POSITION_ERROR, SLICE_POSITION, SLICE_POSITION_ERROR
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError

BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL = 1, 2, 3, 4, 5, 7, 10
_CODES = {BYTE: "B", ASCII: "B", SHORT: "H", LONG: "I", RATIONAL: "I", UNDEFINED: "B", SRATIONAL: "i"}
_PARTS = {RATIONAL: 2, SRATIONAL: 2}
_HEADER_BYTES, _ENTRY_BYTES, _INLINE_BYTES = 8, 12, 4
_LARGEST_BYTES = 2**32 - 2**20
_OF_SLICES = {POSITION: SLICE_POSITION, POSITION_ERROR: SLICE_POSITION_ERROR}
_LEAST_DIOPTRES = 1e-6
PNG_NAME, TIFF_NAME, DNG_NAME, DEPTH_NAME = "all_in_focus.png", "all_in_focus.tif", "all_in_focus.dng", "depth.png"
_SOFTWARE = "mrbokeh"
_RGB, _LINEAR_RAW, _D65 = 2, 34892, 21
_TOP = 65535
_BRIGHTEST = 4.0
_MATRIX_DENOMINATOR, _FINE_DENOMINATOR = 10000, 1000000

Plane = Float32[np.ndarray, "height width"]
Channels = dict[str, Float[np.ndarray, "height width"]]
Rgb = Float32[np.ndarray, "height width 3"]
Rgb8 = UInt8[np.ndarray, "height width 3"]


@dataclass(frozen=True)
class TiffTag:
    """A field of a TIFF directory. kind: a type of TIFF 6.0. values: whole numbers; fractions as numerators and denominators in turn."""

    kind: int
    values: tuple[int, ...]

    def packed(self) -> tuple[int, bytes]:
        """Return (count, bytes) for the directory."""
        return len(self.values) // _PARTS.get(self.kind, 1), struct.pack(f"<{len(self.values)}{_CODES[self.kind]}", *self.values)


def write_readable_pictures(stack: FocalStack, camera_rgb: Rgb | None = None, depth_rgb8: Rgb8 | None = None) -> None:
    """Write the pictures of a merged stack, beside its EXR.

    camera_rgb: its all-in-focus picture as it is stored. depth_rgb8: its `depth_codes`. What is None is read.

    all_in_focus.png: 8 bits, sRGB, nothing tone-mapped: pixels that one slice gave come out as they were in its 8-bit photograph, unless
    its exposure was evened out. all_in_focus.tif: 16 bits with a profile. all_in_focus.dng: of RAW, linear camera RGB.
    """
    if camera_rgb is None:
        camera_rgb = stack.all_in_focus_camera_rgb()
    rgb, orientation, folder = stack.to_rec709(camera_rgb), orientation_of(stack), stack.folder
    write_upright_png(folder / PNG_NAME, rgb, stack)
    _write_srgb_tiff(folder / TIFF_NAME, upright(codes_of(rgb, np.uint16, "srgb"), orientation))
    write_depth_picture(stack, depth_rgb8)
    if stack.rec709_from_camera is not None and stack.metadata.get("white_balance") is not None:
        model = next((model for each in stack.slices if (model := each.metadata.get("camera_model"))), "unknown camera")
        write_linear_dng(folder / DNG_NAME, camera_rgb, stack.rec709_from_camera, stack.metadata["white_balance"], model, orientation)


def write_depth_picture(stack: FocalStack, depth_rgb8: Rgb8 | None = None) -> None:
    """Write depth.png, the depth in colours. depth_rgb8: its `depth_codes`, read if None."""
    codes = depth_codes(stack) if depth_rgb8 is None else depth_rgb8
    write_stored(stack.folder / DEPTH_NAME, upright(codes, orientation_of(stack)))


def readable_names(stack: FocalStack) -> list[str]:
    """Return the names of the files that a merge of this stack writes for people."""
    is_raw = stack.rec709_from_camera is not None and stack.metadata.get("white_balance") is not None
    return [PNG_NAME, TIFF_NAME, *([DNG_NAME] if is_raw else []), DEPTH_NAME]


def depth_m_of(stack: FocalStack, focus_index: Plane) -> Plane | None:
    """Return the focus index in metres, interpolated in dioptres; None where a focus distance is unknown."""
    if not stack.is_metric:
        return None
    dioptres = [1.0 / distance for distance in stack.focus_distances_m if distance is not None]
    interpolated = np.interp(focus_index, np.arange(len(stack)), dioptres)
    return (1.0 / np.maximum(interpolated, _LEAST_DIOPTRES)).astype(np.float32)


def replaced_depth(
    stack: FocalStack,
    channels: Mapping[str, Float[np.ndarray, "height width"]],
    index: Plane,
    confidence: Plane,
    where: Bool[np.ndarray, "height width"],
) -> Channels:
    """Return the channels of depth.exr with another focus index and confidence in some places, and all that follows from the index."""
    new: dict[str, Plane | None] = {"focus_index": index, "confidence": confidence, "Z": depth_m_of(stack, index)}
    for channel, key in _OF_SLICES.items():
        values = [each.metadata.get(key) for each in stack.slices]
        known = channel in channels and None not in values
        new[channel] = np.interp(index, np.arange(len(stack)), np.array(values, float)).astype(np.float32) if known else None
    changed = {name: np.where(where, plane, channels[name]) for name, plane in new.items() if plane is not None and name in channels}
    return dict(channels) | changed


def write_linear_dng(
    path: Path, camera_rgb: Rgb, rec709_from_camera: Matrix3x3, white_balance: Sequence[float], model: str, orientation: int
) -> None:
    """Write white-balanced camera RGB as DNG 1.4 of a sensor without a mosaic (LinearRaw): balanced back, to be balanced as shot.

    Light above the white of green (up to four times) is kept by a scale that BaselineExposure takes back. The matrix is that of daylight
    with the camera's balance in it, which is all that a stack knows and gives our own colours at the balance that was shot.
    """
    neutral = 1.0 / np.asarray(white_balance, np.float64)
    native = camera_rgb * neutral.astype(np.float32)
    scale = float(np.clip(native.max(), 1.0, _BRIGHTEST))
    camera_from_XYZ = neutral[:, None] * (np.linalg.inv(np.asarray(rec709_from_camera)) @ rec709_from_XYZ)
    tags = {
        254: TiffTag(LONG, (0,)),
        262: TiffTag(SHORT, (_LINEAR_RAW,)),
        271: text_tag(_SOFTWARE),
        272: text_tag(model),
        274: TiffTag(SHORT, (orientation,)),
        305: text_tag(_SOFTWARE),
        50706: TiffTag(BYTE, (1, 4, 0, 0)),  # DNGVersion
        50707: TiffTag(BYTE, (1, 1, 0, 0)),  # DNGBackwardVersion
        50708: text_tag(model),  # UniqueCameraModel
        50714: TiffTag(SHORT, (0, 0, 0)),  # BlackLevel
        50717: TiffTag(SHORT, (_TOP, _TOP, _TOP)),  # WhiteLevel
        50721: fractions_tag(camera_from_XYZ.reshape(-1).tolist(), _MATRIX_DENOMINATOR),  # ColorMatrix1
        50728: fractions_tag(neutral.tolist(), _FINE_DENOMINATOR, RATIONAL),  # AsShotNeutral
        50730: fractions_tag([math.log2(scale)], _FINE_DENOMINATOR),  # BaselineExposure
        50778: TiffTag(SHORT, (_D65,)),  # CalibrationIlluminant1
    }
    write_tiff(path, even_codes(native / np.float32(scale), np.uint16), tags)


def _write_srgb_tiff(path: Path, codes: UInt16[np.ndarray, "height width 3"]) -> None:
    tags = {
        262: TiffTag(SHORT, (_RGB,)),
        274: TiffTag(SHORT, (1,)),
        305: text_tag(_SOFTWARE),
        34675: TiffTag(UNDEFINED, tuple(_srgb_profile())),
    }
    write_tiff(path, codes, tags)


def _srgb_profile() -> bytes:
    from PIL import ImageCms

    return ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def write_tiff(path: Path, pixels: UInt16[np.ndarray, "height width 3"], tags: Mapping[int, TiffTag]) -> None:
    """Write red, green and blue of 16 bits atomically: little-endian, one strip, uncompressed, which takes a tenth of LZW's time.

    tags: by their numbers, beside those that say where the pixels are; photometry is among them. Raises InputError for what is larger
    than the 4 GB of TIFF.
    """
    if pixels.nbytes > _LARGEST_BYTES:
        raise InputError(f"{path}: a picture of {pixels.shape[1]}x{pixels.shape[0]} px is larger than a TIFF can be (4 GB)")
    height, width, channels = pixels.shape
    all_tags = {
        256: TiffTag(LONG, (width,)),
        257: TiffTag(LONG, (height,)),
        258: TiffTag(SHORT, (16,) * channels),
        259: TiffTag(SHORT, (1,)),
        273: TiffTag(LONG, (_HEADER_BYTES,)),
        277: TiffTag(SHORT, (channels,)),
        278: TiffTag(LONG, (height,)),
        279: TiffTag(LONG, (pixels.nbytes,)),
        284: TiffTag(SHORT, (1,)),
        **tags,
    }
    directory_at = _HEADER_BYTES + pixels.nbytes
    with atomic_path(path) as temporary, temporary.open("wb") as file:
        file.write(struct.pack("<2sHI", b"II", 42, directory_at))
        file.write(np.ascontiguousarray(pixels, "<u2").data)
        file.write(_directory(all_tags, directory_at))


def _directory(tags: Mapping[int, TiffTag], at: int) -> bytes:
    """Return the entries in rising order, then the values that do not fit into them, at even places."""
    values_at = at + 2 + _ENTRY_BYTES * len(tags) + 4
    entries, beyond = b"", b""
    for number in sorted(tags):
        count, packed = tags[number].packed()
        if len(packed) <= _INLINE_BYTES:
            place = packed.ljust(_INLINE_BYTES, b"\x00")
        else:
            place = struct.pack("<I", values_at + len(beyond))
            beyond += packed + b"\x00" * (len(packed) % 2)
        entries += struct.pack("<HHI", number, tags[number].kind, count) + place
    return struct.pack("<H", len(tags)) + entries + struct.pack("<I", 0) + beyond


def text_tag(text: str) -> TiffTag:
    return TiffTag(ASCII, (*text.encode("ascii", "replace"), 0))


def fractions_tag(values: Sequence[float], denominator: int, kind: int = SRATIONAL) -> TiffTag:
    return TiffTag(kind, tuple(each for value in values for each in (round(value * denominator), denominator)))
