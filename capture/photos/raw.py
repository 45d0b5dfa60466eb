"""Camera RAW to linear white-balanced camera RGB, unclipped, on one exposure scale: 1.0 is where the raw green channel saturates."""

from collections.abc import Iterator
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float32

from capture.photos.clipped_highlights import neutral_where_full
from capture.photos.decoded_photo import DecodedPhoto, Photosites
from capture.photos.libraw import MAX_16_BIT, WhiteBalance, matrix_used_by_libraw, opened_raw, processed, rec709_from_balanced_camera
from capture.photos.photo_metadata import PhotoMetadata
from capture.photos.saturation import full_photosites, saturated_share
from capture.photos.whole_file import require_whole_tiff
from capture.photos.x_trans import X_TRANS_SIZE, decode_in_one_thread, decodes_reproducibly
from mrbokeh.images.camera_rgb import matrix3x3
from mrbokeh.system.errors import InputError

if TYPE_CHECKING:
    import rawpy

RAW_SUFFIXES = (
    ".3fr", ".ari", ".arw", ".bay", ".cap", ".cr2", ".cr3", ".crw", ".dcr", ".dcs", ".dng", ".drf",
    ".erf", ".fff", ".gpr", ".iiq", ".k25", ".kdc", ".mdc", ".mef", ".mos", ".mrw", ".nef", ".nrw",
    ".orf", ".pef", ".ptx", ".pxn", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f",
)  # fmt: skip


def decode_raw(path: Path, white_balance: WhiteBalance | None = None, *, half_size: bool = False) -> DecodedPhoto:
    """A RAW file in linear camera RGB. white_balance: multipliers of red, green, blue, or None for the camera's own.

    half_size: one pixel per 2x2 photosites, without demosaicing: fast, for a quick look. X-Trans is decoded in a process
    of its own (capture.photos.x_trans), so that it comes out the same every time.
    Raises InputError where LibRaw cannot decode the file, the file is cut short, or the sensor does not see RGB.
    """
    require_whole_tiff(path)
    with opened_raw(path) as raw:
        raw.unpack()
        apart = raw.raw_pattern is not None and raw.raw_pattern.shape == X_TRANS_SIZE and not decodes_reproducibly()
        if not apart:
            return _decoded(raw, white_balance, half_size)
    return decode_in_one_thread(path, white_balance, half_size)


def _decoded(raw: "rawpy.RawPy", white_balance: WhiteBalance | None, half_size: bool) -> DecodedPhoto:
    # The pattern changes once a half-size picture was made, hence everything about the mosaic is asked before.
    remarks = list(_remarks(raw))
    multipliers = _normalised(white_balance) if white_balance is not None else _camera_white_balance(raw)
    matrix = rec709_from_balanced_camera(np.array(raw.color_matrix), np.array(raw.rgb_xyz_matrix))
    full = full_photosites(raw)
    camera_rgb = neutral_where_full(_balanced_camera_rgb(raw, multipliers, half_size), multipliers)
    if matrix is None:
        matrix = matrix_used_by_libraw(raw)
        remarks += ["LibRaw has no colour matrix for this camera: its own primaries are kept"] if np.allclose(matrix, np.eye(3)) else []
    share = saturated_share(full, camera_rgb, multipliers)
    return DecodedPhoto(camera_rgb, matrix3x3(matrix), share, _count(full), multipliers, 1.0, tuple(remarks))


def _count(full: Bool[np.ndarray, "sensor_height sensor_width"]) -> Photosites:
    return Photosites(full.shape[1], full.shape[0], int(np.count_nonzero(full)))


def camera_white_balance(path: Path) -> WhiteBalance:
    """The white balance that the camera chose, as multipliers of red, green, blue with green at 1."""
    with opened_raw(path) as raw:
        return _camera_white_balance(raw)


def read_raw_metadata(path: Path) -> PhotoMetadata:
    """The shooting data that LibRaw knows, for formats whose EXIF has gaps; all None where it cannot open the file."""
    try:
        with opened_raw(path) as raw:
            other, lens_model = raw.other, raw.lens.model
    except InputError:
        return PhotoMetadata()
    numbers = (other.focal_length, other.aperture, other.shutter_speed, other.iso_speed)
    focal_length_mm, f_number, exposure_time_s, iso = (float(each) if each > 0 else None for each in numbers)
    taken_at = other.timestamp if isinstance(other.timestamp, datetime) and other.timestamp.year > 1970 else None
    return PhotoMetadata(focal_length_mm, f_number, exposure_time_s, iso, taken_at, lens_model=lens_model or None)


def _normalised(multipliers: WhiteBalance) -> WhiteBalance:
    red, green, blue = (float(each) for each in multipliers)
    if min(red, green, blue) <= 0 or not np.isfinite([red, green, blue]).all():
        raise InputError(f"a white balance needs three positive multipliers for red, green, blue, got {multipliers}")
    return red / green, 1.0, blue / green


def _camera_white_balance(raw: "rawpy.RawPy") -> WhiteBalance:
    """The camera's choice, else LibRaw's daylight for that camera, else none."""
    for stated in (raw.camera_whitebalance, raw.daylight_whitebalance):
        if len(stated) >= 3 and min(stated[:3]) > 0 and np.isfinite(stated[:3]).all():
            return _normalised((stated[0], stated[1], stated[2]))
    return (1.0, 1.0, 1.0)


def _remarks(raw: "rawpy.RawPy") -> Iterator[str]:
    pattern, aspect = raw.raw_pattern, raw.sizes.pixel_aspect
    if min(raw.camera_whitebalance[:3]) <= 0:
        yield "the file states no white balance: LibRaw's daylight multipliers stand in unless others are given"
    if pattern is None and raw.num_colors == 3:
        yield "the file holds RGB without a mosaic (linear DNG, sRAW): it was demosaiced, perhaps reduced, before"
    if abs(aspect - 1.0) > 1e-3:
        yield f"the sensor's pixels are {aspect:.3f} times as wide as high: the picture was resampled to square pixels"


def _balanced_camera_rgb(raw: "rawpy.RawPy", multipliers: WhiteBalance, half_size: bool) -> Float32[np.ndarray, "height width 3"]:
    """White-balanced camera RGB in which 1.0 is the white level of green and nothing is clipped above."""
    import rawpy

    pixels = processed(raw, multipliers, rawpy.ColorSpace.raw, half_size)
    # With "Ignore" LibRaw scales so that the largest multiplier is 1 and nothing exceeds 16 bit; undo that.
    linear = pixels.astype(np.float32)
    linear *= np.float32(max(multipliers) / multipliers[1]) / np.float32(MAX_16_BIT)
    return linear if linear.ndim == 3 and linear.shape[2] == 3 else np.repeat(linear.reshape(*linear.shape[:2], 1), 3, axis=2)
