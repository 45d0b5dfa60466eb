"""Depth maps in files of plain numbers, whose meaning the user states: PNG and TIFF, and arrays of stereo disparity."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.depth.depth_map import DepthMap
from mrbokeh.depth.depth_settings import DepthSettings
from mrbokeh.images.picture_codec import stored_pixels
from mrbokeh.system.errors import InputError

Plane = Float32[np.ndarray, "height width"]


def read_number_map(path: Path, settings: DepthSettings) -> DepthMap:
    """An integer or float picture. With metres_per_unit it holds depth (0: unknown), with near_far_m dioptres, largest number nearest.

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
    return from_levels(_levels(numbers), settings.near_far_m, known, f"{path.name}, linear in dioptres")


def from_levels(levels: Plane, near_far_m: tuple[float, float], known: np.ndarray, note: str) -> DepthMap:
    """levels: 1 is near, 0 is far, evenly in dioptres."""
    near_m, far_m = near_far_m
    dioptres = levels / near_m + (1.0 - levels) / far_m
    return DepthMap.of_dioptres(dioptres.astype(np.float32), known, f"{note}, {near_m:g} to {far_m:g} m")


def _levels(numbers: np.ndarray) -> Plane:
    if numbers.dtype.kind in "ui":
        return (numbers / np.float32(np.iinfo(numbers.dtype).max)).astype(np.float32)
    low, high = float(np.nanmin(numbers)), float(np.nanmax(np.where(np.isfinite(numbers), numbers, np.nan)))
    return np.clip((np.nan_to_num(numbers, posinf=high, neginf=low, nan=low) - low) / max(high - low, 1e-30), 0, 1).astype(np.float32)


def read_stereo(path: Path, settings: DepthSettings) -> DepthMap:
    """Disparity in pixels (.npz, .npy: its first array), as in the Middlebury data sets; what is not finite is unknown."""
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
