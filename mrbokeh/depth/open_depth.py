"""Depth of a photograph from any source, at the photograph's size."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.depth.depth_filters import refined_dioptres
from mrbokeh.depth.depth_map import DepthMap, DepthSettings, with_holes_filled
from mrbokeh.depth.phone_depth import read_phone_photo
from mrbokeh.images.image_io import read_depth
from mrbokeh.images.picture_codec import stored_pixels
from mrbokeh.optics.camera import have_same_shape
from mrbokeh.system.errors import InputError

Plane = Float32[np.ndarray, "height width"]


def read_number_map(path: Path, settings: DepthSettings) -> DepthMap:
    """Read a picture of plain numbers: depth with metres_per_unit (0: unknown), dioptres with near_far_m, the largest number nearest.

    For near_far_m the whole range of an integer format counts (0 is FAR, 65535 is NEAR), of floats the range that occurs.
    """
    pixels = stored_pixels(path)
    numbers = pixels if pixels.ndim == 2 else pixels[..., 0]
    known = np.isfinite(numbers)
    if settings.metres_per_unit is not None:
        known &= numbers > 0
        depth_m = np.where(known, numbers * np.float32(settings.metres_per_unit), np.inf).astype(np.float32)
        return DepthMap(depth_m, known, f"{path.name}, {settings.metres_per_unit:g} m per step")
    if settings.near_far_m is None:
        raise InputError(
            f"{path} does not say what its numbers mean: give --disparity NEAR:FAR in metres (largest number nearest, even steps of "
            f"1/distance), or --depth-scale METRES_PER_STEP"
        )
    return DepthMap.of_levels(_levels(numbers), settings.near_far_m, known, f"{path.name}, linear in dioptres")


def _levels(numbers: np.ndarray) -> Plane:
    if numbers.dtype.kind in "ui":
        return (numbers / np.float32(np.iinfo(numbers.dtype).max)).astype(np.float32)
    low, high = float(np.nanmin(numbers)), float(np.nanmax(np.where(np.isfinite(numbers), numbers, np.nan)))
    return np.clip((np.nan_to_num(numbers, posinf=high, neginf=low, nan=low) - low) / max(high - low, 1e-30), 0, 1).astype(np.float32)


def read_stereo(path: Path, settings: DepthSettings) -> DepthMap:
    """Read disparity in pixels (.npz, .npy: its first array), as in the Middlebury data sets; what is not finite is unknown."""
    if settings.stereo is None:
        raise InputError(f"{path} holds disparity: state the cameras with --stereo FOCAL_PX,BASELINE_M,OFFSET_PX")
    try:
        loaded = np.load(path)
        disparity = np.asarray(loaded[loaded.files[0]] if hasattr(loaded, "files") else loaded, np.float32)
    except (OSError, ValueError, IndexError) as error:
        raise InputError(f"{path} cannot be read as an array of disparity: {error}") from None
    if disparity.ndim != 2:
        raise InputError(f"{path}: expected disparity (H, W) in pixels, got an array of shape {disparity.shape}")
    calibration = settings.stereo
    known = np.isfinite(disparity)
    dioptres = (np.where(known, disparity, 0.0) + calibration.offset_px) / (calibration.focal_px * calibration.baseline_m)
    return DepthMap.of_dioptres(dioptres.astype(np.float32), known, f"{path.name}, stereo of {calibration.baseline_m:g} m")


Rgb = Float32[np.ndarray, "height width 3"]

_ARRAYS = (".npz", ".npy")
_SAME_ASPECT = 0.02


def open_depth(source: Path, photo_rgb: Rgb, settings: DepthSettings | None = None) -> DepthMap:
    """Read depth from any source and bring it to the photograph's size along its edges.

    source: EXR with Z, PNG or TIFF (settings say what the numbers mean), disparity of stereo (.npz, .npy), a phone's JPEG with GDepth
    inside, or a depth network (.onnx). photo_rgb: (H, W, 3) linear.
    Raises InputError if the source cannot be read, does not say what it means, or is of another shape than the photograph.
    """
    settings = settings or DepthSettings()
    if not source.is_file():
        raise InputError(f"expected depth at {source}, but there is no such file")
    depth, is_soft = _read(source, photo_rgb, settings)
    _require_same_aspect(source, depth, photo_rgb)
    filled = with_holes_filled(depth)
    refine = is_soft if settings.refined is None else settings.refined
    return _at_size_of(filled, photo_rgb, refine)


def _read(source: Path, photo_rgb: Rgb, settings: DepthSettings) -> tuple[DepthMap, bool]:
    """Return the map at its own size, and whether such maps have soft edges."""
    suffix = source.suffix.lower()
    if suffix == ".onnx":
        from mrbokeh.depth.depth_network import network_depth

        return network_depth(source, photo_rgb, settings), True
    if suffix == ".exr":
        depth_m = read_depth(source)
        return DepthMap(depth_m, np.ones(depth_m.shape, bool), source.name), False
    if suffix in _ARRAYS:
        return read_stereo(source, settings), False
    phone = read_phone_photo(source, settings.near_far_m)
    return (read_number_map(source, settings), settings.metres_per_unit is None) if phone is None else (phone.depth, True)


def _require_same_aspect(source: Path, depth: DepthMap, photo_rgb: Rgb) -> None:
    (rows, columns), (height, width) = depth.depth_m.shape, photo_rgb.shape[:2]
    if not have_same_shape((columns, rows), (width, height), _SAME_ASPECT):
        raise InputError(
            f"{source} is {columns}x{rows} px, the photograph {width}x{height} px: expected one view, cut the same way (is one turned?)"
        )


def _at_size_of(depth: DepthMap, photo_rgb: Rgb, refine: bool) -> DepthMap:
    import cv2

    height, width = photo_rgb.shape[:2]
    size = (width, height)
    valid = cv2.resize(depth.valid.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    if refine:
        return DepthMap.of_dioptres(np.maximum(refined_dioptres(depth.dioptres, photo_rgb), 0.0), valid, f"{depth.note}, edges refined")
    if depth.depth_m.shape == (height, width):
        return depth
    return DepthMap(cv2.resize(depth.depth_m, size, interpolation=cv2.INTER_NEAREST), valid, f"{depth.note}, resized")
