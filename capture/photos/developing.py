"""Photographs of any kind to linear light at the size asked for; for compositing also upright in Rec.709, with lens and exposure."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from capture.photos.libraw import dilated, resized_share
from capture.photos.metadata import read_metadata
from capture.photos.raw import RAW_SUFFIXES, DecodedPhoto, Photosites, decode_raw
from mrbokeh.images.color import convert
from mrbokeh.images.exif import cut_from_px, known_orientation, quarter_turns, stored_orientation, upright
from mrbokeh.images.image_io import ENCODED_SUFFIXES, LINEAR_SUFFIXES, read_image
from mrbokeh.images.picture_codec import linear_from_codes, stored_rgb
from mrbokeh.stacks.photograph import Photograph
from mrbokeh.system.errors import InputError

_LARGEST_HALF = 65504.0
_FULL = 1.0 - 1e-6


def is_raw(path: Path) -> bool:
    return path.suffix.lower() in RAW_SUFFIXES


def develop(
    path: Path, white_balance: tuple[float, float, float] | None, *, half_size: bool = False, max_width: int | None = None
) -> DecodedPhoto:
    """Return a photograph in linear light, the way up in which it is stored (EXIF orientation is not applied).

    RAW through `decode_raw` in camera RGB; PNG, TIFF, JPEG, WebP and HEIC by their colour profile, EXR and HDR as they are, all in
    Rec.709. Smaller sizes are area averages of light, and of the share that is saturated.
    """
    if is_raw(path):
        decoded = decode_raw(path, white_balance, half_size=half_size)
    else:
        suffixes = (*LINEAR_SUFFIXES, *ENCODED_SUFFIXES)
        if path.is_file() and path.suffix.lower() not in suffixes:
            raise InputError(
                f"{path}: expected a photograph, RAW (such as .dng, .nef, .cr3, .arw) or one of {', '.join(suffixes)}, not "
                f"{path.suffix or 'a file without suffix'}"
            )
        decoded = _picture(path)
        if half_size:
            decoded = _no_wider(decoded, max(1, decoded.rgb.shape[1] // 2))
    return decoded if max_width is None else _no_wider(decoded, max_width)


def read_photograph(path: Path) -> Photograph:
    """Read a photograph for compositing. White balance is the camera's own; EXR and HDR are taken as they are."""
    decoded, metadata = develop(path, None), read_metadata(path)
    rgb = decoded.rgb if decoded.rec709_from_camera is None else convert(decoded.rgb, np.array(decoded.rec709_from_camera))
    orientation = known_orientation(metadata.orientation or stored_orientation(path))
    turns = quarter_turns(orientation)
    stored_height_px, stored_width_px = rgb.shape[:2]
    sensor = metadata.sensor
    sensor_width_mm = None if sensor is None else sensor.width_mm(decoded.photosites.width, decoded.photosites.height)
    if sensor_width_mm is not None and turns % 2:
        sensor_width_mm *= stored_height_px / stored_width_px
    # A camera set to another shape cuts its JPEG only, and RAW has margins.
    whole_px = None if is_raw(path) else cut_from_px((stored_width_px, stored_height_px), metadata.taken_size_px)
    return Photograph(
        rgb=upright(rgb, orientation),
        focal_length_mm=metadata.focal_length_mm,
        f_number=metadata.f_number,
        focus_distance_m=metadata.focus_distance_m,
        sensor_width_mm=sensor_width_mm,
        sensor_doubt="" if sensor is None else sensor.doubt,
        rough_focus_m=metadata.rough_focus_m,
        exposure_time_s=metadata.exposure_time_s,
        iso=metadata.iso,
        orientation=orientation,
        cut_from_px=whole_px[::-1] if whole_px is not None and turns % 2 else whole_px,
    )


def _picture(path: Path) -> DecodedPhoto:
    if path.suffix.lower() in ENCODED_SUFFIXES:
        return _encoded(path)
    rgb, remarks = _finite(read_image(path))
    height, width = rgb.shape[:2]
    return DecodedPhoto(rgb, None, np.zeros((height, width), np.float32), Photosites(width, height), saturation_level=None, remarks=remarks)


def _finite(rgb: np.ndarray) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the light with numbers alone, and a remark where some were none."""
    finite = np.isfinite(rgb)
    if finite.all():
        return rgb, ()
    remark = f"{np.count_nonzero(~finite.all(axis=-1))} pixels were not finite: NaN became 0, infinity {_LARGEST_HALF:g}"
    return np.nan_to_num(rgb, nan=0.0, posinf=_LARGEST_HALF, neginf=0.0), (remark,)


def _encoded(path: Path) -> DecodedPhoto:
    """Decode a picture whose codes are display-encoded; full is the largest code in any channel (TIFF of floats: 1)."""
    codes = stored_rgb(path)[..., :3]
    is_float = codes.dtype.kind == "f"
    codes, remarks = _finite(codes) if is_float else (codes, ())
    rgb = codes.astype(np.float32) if is_float else linear_from_codes(codes, "srgb", path)
    red, green, blue = cv2.split(np.ascontiguousarray(codes))
    full = cv2.max(cv2.max(red, green), blue) >= (_FULL if is_float else np.iinfo(codes.dtype).max)
    photosites, saturated = Photosites(full.shape[1], full.shape[0], int(np.count_nonzero(full))), dilated(full).astype(np.float32)
    return DecodedPhoto(rgb, None, saturated, photosites, half_suffices=codes.dtype == np.uint8, remarks=remarks)


def _no_wider(decoded: DecodedPhoto, width: int) -> DecodedPhoto:
    """Average over areas in linear light, so that small lights keep their energy."""
    height_now, width_now = decoded.rgb.shape[:2]
    if width_now <= width:
        return decoded
    height = max(1, round(height_now * width / width_now))
    rgb = cv2.resize(decoded.rgb, (width, height), interpolation=cv2.INTER_AREA)
    return replace(decoded, rgb=rgb, saturated=resized_share(decoded.saturated, width, height))
