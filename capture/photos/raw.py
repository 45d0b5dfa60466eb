"""Camera RAW to linear white-balanced camera RGB, unclipped, on one exposure scale: 1.0 is where the raw green channel saturates.

X-Trans files are decoded by a Python of their own with one thread, for LibRaw's parallel decoding of them is not reproducible (issue
845): between 0.03 and 0.16 % of the samples of a compressed RAF differ from run to run, and its demosaicing of
X-Trans does too (1033 of 972 000 samples of an uncompressed DNG on two cores), unless OMP_NUM_THREADS=1 was set before
LibRaw was loaded, which only a new process can still do. It is spawned, never forked: OpenMP deadlocks in a forked child.
"""

import os
import pickle
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float32

from capture.photos.libraw import (
    MAX_16_BIT,
    WhiteBalance,
    full_photosites,
    matrix_used_by_libraw,
    neutral_where_full,
    opened_raw,
    processed,
    rec709_from_balanced_camera,
    saturated_share,
)
from capture.photos.metadata import require_whole_tiff
from capture.photos.photo_metadata import PhotoMetadata
from mrbokeh.images.camera_rgb import Matrix3x3, matrix3x3
from mrbokeh.system.errors import InputError

if TYPE_CHECKING:
    import rawpy

X_TRANS_SIZE = (6, 6)
_VARIABLE = "OMP_NUM_THREADS"
_WORKER = "from capture.photos.raw import serve_one_order; serve_one_order()"
# OpenMP reads it once: what is set later does not count.
_AT_START = os.environ.get(_VARIABLE)
RAW_SUFFIXES = (
    ".3fr", ".ari", ".arw", ".bay", ".cap", ".cr2", ".cr3", ".crw", ".dcr", ".dcs", ".dng", ".drf",
    ".erf", ".fff", ".gpr", ".iiq", ".k25", ".kdc", ".mdc", ".mef", ".mos", ".mrw", ".nef", ".nrw",
    ".orf", ".pef", ".ptx", ".pxn", ".raf", ".raw", ".rw2", ".rwl", ".sr2", ".srf", ".srw", ".x3f",
)  # fmt: skip


@dataclass(frozen=True)
class Photosites:
    """Grid of the sensor before any reduction, and how many of its photosites gave no more than "full"."""

    width: int
    height: int
    full: int = 0

    @property
    def full_fraction(self) -> float:
        return self.full / (self.width * self.height)


@dataclass(frozen=True)
class DecodedPhoto:
    """Photograph in linear light.

    rgb: (H, W, 3) white-balanced camera RGB; Rec.709 where rec709_from_camera is None (JPEG, EXR).
    saturated: (H, W) how much of each pixel comes from full photosites or their neighbours in demosaicing, 0 to 1.
    white_balance: multipliers of red, green, blue, green being 1; None where it was applied before (JPEG, EXR).
    saturation_level: the linear value of a saturated green or grey; None where there is no such thing (EXR).
    remarks: what a reader of the result should know.
    half_suffices: the file holds 8 bits a channel. Their steps are 0.9 % near white and more below, those of half 0.1 % at most; 14-bit RAW
    and 16-bit files have finer ones near white (0.006 %) than half (0.05 %).
    """

    rgb: Float32[np.ndarray, "height width 3"]
    rec709_from_camera: Matrix3x3 | None
    saturated: Float32[np.ndarray, "height width"]
    photosites: Photosites
    white_balance: WhiteBalance | None = None
    saturation_level: float | None = 1.0
    remarks: tuple[str, ...] = ()
    half_suffices: bool = False


def decode_raw(path: Path, white_balance: WhiteBalance | None = None, *, half_size: bool = False) -> DecodedPhoto:
    """Decode a RAW file to linear camera RGB. white_balance: multipliers of red, green, blue, or None for the camera's own.

    half_size: one pixel per 2x2 photosites, without demosaicing: fast, for a quick look. X-Trans is decoded in a process
    of its own, so that it comes out the same every time.
    Raises InputError if LibRaw cannot decode the file, the file is cut short, or the sensor does not see RGB.
    """
    require_whole_tiff(path)
    with opened_raw(path) as raw:
        raw.unpack()
        apart = raw.raw_pattern is not None and raw.raw_pattern.shape == X_TRANS_SIZE and not decodes_reproducibly()
        if not apart:
            return _decoded(raw, white_balance, half_size)
    return decode_in_one_thread(path, white_balance, half_size)


def camera_white_balance(path: Path) -> WhiteBalance:
    """Return the white balance that the camera chose, as multipliers of red, green, blue with green at 1."""
    with opened_raw(path) as raw:
        return _camera_white_balance(raw)


def read_raw_metadata(path: Path) -> PhotoMetadata:
    """Return the shooting data that LibRaw knows, for formats whose EXIF has gaps; all None where it cannot open the file."""
    try:
        with opened_raw(path) as raw:
            other, lens_model = raw.other, raw.lens.model
    except InputError:
        return PhotoMetadata()
    numbers = (other.focal_length, other.aperture, other.shutter_speed, other.iso_speed)
    focal_length_mm, f_number, exposure_time_s, iso = (float(each) if each > 0 else None for each in numbers)
    taken_at = other.timestamp if isinstance(other.timestamp, datetime) and other.timestamp.year > 1970 else None
    return PhotoMetadata(
        focal_length_mm=focal_length_mm,
        f_number=f_number,
        exposure_time_s=exposure_time_s,
        iso=iso,
        taken_at=taken_at,
        lens_model=lens_model or None,
    )


def decodes_reproducibly() -> bool:
    """Return whether this process was started with one OpenMP thread."""
    return _AT_START == "1"


def decode_in_one_thread(path: Path, white_balance: WhiteBalance | None, half_size: bool) -> DecodedPhoto:
    """Call `decode_raw` in a process of its own with one thread; errors come back as they were."""
    with tempfile.TemporaryDirectory(prefix="mrbokeh_") as folder:
        result = Path(folder) / "decoded.pickle"
        order = pickle.dumps((Path(path), white_balance, half_size, result))
        search = os.pathsep.join(each for each in sys.path if each)
        environment = os.environ | {_VARIABLE: "1", "PYTHONPATH": search}
        done = subprocess.run([sys.executable, "-c", _WORKER], input=order, env=environment, capture_output=True)
        if done.returncode != 0 or not result.is_file():
            last_line = (done.stderr.decode(errors="replace").strip().splitlines() or ["no message"])[-1]
            raise InputError(
                f"{path} cannot be decoded as RAW: the process that decodes X-Trans ended with {done.returncode} ({last_line})"
            )
        with result.open("rb") as file:
            answer = pickle.load(file)
    if isinstance(answer, InputError):
        raise answer
    assert isinstance(answer, DecodedPhoto)
    return answer


def serve_one_order() -> None:
    """Decode the photograph that an order on standard input names, into a file: the process that `decode_in_one_thread` starts."""
    path, white_balance, half_size, result = pickle.load(sys.stdin.buffer)
    try:
        answer: DecodedPhoto | InputError = decode_raw(path, white_balance, half_size=half_size)
    except InputError as error:
        answer = error
    with open(result, "wb") as file:
        pickle.dump(answer, file, protocol=pickle.HIGHEST_PROTOCOL)


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
    return DecodedPhoto(
        rgb=camera_rgb,
        rec709_from_camera=matrix3x3(matrix),
        saturated=share,
        photosites=Photosites(full.shape[1], full.shape[0], int(np.count_nonzero(full))),
        white_balance=multipliers,
        saturation_level=1.0,
        remarks=tuple(remarks),
    )


def _normalised(multipliers: WhiteBalance) -> WhiteBalance:
    red, green, blue = (float(each) for each in multipliers)
    if min(red, green, blue) <= 0 or not np.isfinite([red, green, blue]).all():
        raise InputError(f"a white balance needs three positive multipliers for red, green, blue, got {multipliers}")
    return red / green, 1.0, blue / green


def _camera_white_balance(raw: "rawpy.RawPy") -> WhiteBalance:
    """Return the camera's choice, else LibRaw's daylight for that camera, else none."""
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
    """Return white-balanced camera RGB in which 1.0 is the white level of green and nothing is clipped above."""
    import rawpy

    pixels = processed(raw, multipliers, rawpy.ColorSpace.raw, half_size)
    # With "Ignore" LibRaw scales so that the largest multiplier is 1 and nothing exceeds 16 bit; undo that.
    linear = pixels.astype(np.float32)
    linear *= np.float32(max(multipliers) / multipliers[1]) / np.float32(MAX_16_BIT)
    return linear if linear.ndim == 3 and linear.shape[2] == 3 else np.repeat(linear.reshape(*linear.shape[:2], 1), 3, axis=2)
