"""Photographs of scenes that are known, as a camera would leave them on its card."""

import math
import struct
from datetime import datetime, timedelta
from fractions import Fraction
from pathlib import Path

import numpy as np
from jaxtyping import Float32
from scipy.ndimage import gaussian_filter

from capture.stacks.ingest import IngestReport
from datasets_scripts.made_sets.simulated_camera import SensorModel, ShotMetadata, write_dng
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack

Picture = Float32[np.ndarray, "height width 3"]
LENS = Lens(35.0, 2.8, 1.0, 23.5)
DISTANCES_M = (1.4, 0.6, 0.8, math.inf, 1.0)


def scene_rgb(height: int, width: int, seed: int = 0) -> Picture:
    """Soft blobs of all sizes (a 1/f spectrum, like photographs) in three colours, 0.02 to 0.6, and two lamps above white."""
    rng = np.random.default_rng(seed)
    fy, fx = np.fft.fftfreq(height)[:, None], np.fft.fftfreq(width)[None]
    spectrum = 1.0 / np.maximum(np.hypot(fy, fx), 1.0 / width)
    noise = np.stack([np.fft.ifft2(np.fft.fft2(rng.normal(size=(height, width))) * spectrum).real for _ in range(3)], axis=-1)
    noise = (noise - noise.min()) / (noise.max() - noise.min())
    rgb = 0.02 + 0.58 * gaussian_filter(noise**2, (1.5, 1.5, 0.0))
    rgb[height // 3 : height // 3 + 6, width // 4 : width // 4 + 6] = 4.0
    rgb[height // 2 : height // 2 + 6, 3 * width // 4 : 3 * width // 4 + 6] = 4.0
    return rgb.astype(np.float32)


def make_raw_photo(path: Path, rgb: Picture, focus_m: float, exposure_time_s: Fraction = Fraction(1, 60), seconds: int = 0) -> Path:
    """A noise-free DNG of a scene; the exposure time acts on the pixels."""
    sensor = SensorModel(full_well_electrons=0.0, read_noise_electrons=0.0)
    mosaic = sensor.linear_mosaic(rgb * np.float32(exposure_time_s * 60))
    taken_at = datetime(2025, 6, 1, 12) + timedelta(seconds=seconds)
    shot = ShotMetadata(LENS.focused_at(min(focus_m, 10.0)), exposure_time_s=exposure_time_s, taken_at=taken_at)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_dng(path, sensor.quantise(np.minimum(mosaic, 1.0)), sensor, shot)
    if math.isinf(focus_m):
        state_infinity(path)
    return path


def set_exif(path: Path, **tags: str) -> None:
    """Tags by their last name: Model, Orientation (of Exif.Image), SubjectDistance, FNumber (of Exif.Photo)."""
    import pyexiv2

    groups = {"Model": "Image", "Orientation": "Image"}
    with pyexiv2.Image(str(path)) as image:
        image.modify_exif({f"Exif.{groups.get(name, 'Photo')}.{name}": value for name, value in tags.items()})


def state_infinity(path: Path) -> None:
    """SubjectDistance 0xFFFFFFFF / 1. exiv2 reads that but writes at most 0x7FFFFFFF, so the last bit is set by hand."""
    set_exif(path, SubjectDistance="2147483647/1")
    written, meant = (struct.pack("<II", numerator, 1) for numerator in (0x7FFFFFFF, 0xFFFFFFFF))
    data = path.read_bytes()
    assert data.count(written) == 1
    path.write_bytes(data.replace(written, meant))


def set_neutral(path: Path, red: float, blue: float) -> None:
    """Another white balance of the camera's: what red and blue answer to white where green answers 1 (exiv2 cannot write that tag)."""
    sensor = SensorModel()
    millionths = [round(each * 1_000_000) for each in (*sensor.as_shot_neutral, red, 1.0, blue)]
    written, meant = (
        struct.pack("<6I", *(part for each in values for part in (each, 1_000_000))) for values in (millionths[:3], millionths[3:])
    )
    data = path.read_bytes()
    assert data.count(written) == 1
    path.write_bytes(data.replace(written, meant))


def make_shoot(folder: Path, blur_px: float = 0.0) -> Path:
    """Five DNGs in an order of names that is not the order of their focus; each blurred (sigma) by blur_px more than the one before."""
    for index, focus_m in enumerate(DISTANCES_M):
        rgb = defocused(scene_rgb(72, 96), blur_px * index)
        make_raw_photo(folder / f"IMG_{index + 8}.dng", rgb, focus_m, seconds=2 * index)
    return folder


def defocused(rgb: Picture, sigma_px: float) -> Picture:
    """What tells the slices of a stack apart."""
    return gaussian_filter(rgb, (sigma_px, sigma_px, 0.0)).astype(np.float32)


def only_stack(report: IngestReport) -> FocalStack:
    assert len(report.stacks) == 1
    return report.stacks[0].stack


def sources(stack: FocalStack) -> list[str]:
    return [each.metadata["source"] for each in stack.slices]
