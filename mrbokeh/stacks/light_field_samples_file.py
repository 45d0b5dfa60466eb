"""Files of light field samples: NumPy archives (.npz) and multi-part OpenEXR.

NPZ: `version` (1), `width_px`, `height_px` and the arrays of `LightFieldSamples` by their names.

EXR: one part per sample of a pixel, `sample00`, `sample01`, ..., each a picture of the size of the frame whose pixel (i, j)
holds one sample that fell on it, in 32 bit channels (16 bit are read as well):
    R, G, B                  scene-linear light, Rec.709 or the primaries that the file states
    Z                        depth along the axis in metres; inf is background, 0 says that the pixel has no such sample
    lens.u, lens.v           place in the unit pupil, x right, y down
    time                     0 (shutter opens) to 1 (it closes)
    forward.u, forward.v     motion in pixels during the shutter, right and up as renderers count it
    x, y                     where the ray met the sensor, in pixels from the top left corner (the pixel's centre is (i + 0.5, j + 0.5))
"""

from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.images.exr_io import ExrPart, in_rec709, read_exr, stated_primaries, write_exr
from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError, require_file

VERSION = 1
CHANNELS = {
    "rgb": ("R", "G", "B"),
    "depth_m": ("Z",),
    "lens_uv": ("lens.u", "lens.v"),
    "time": ("time",),
    "motion_px": ("forward.u", "forward.v"),
    "xy_px": ("x", "y"),
}
_UPWARDS = "forward.v"
_SUFFIXES = (".npz", ".exr")


def write_samples(path: Path | str, samples: LightFieldSamples) -> None:
    """Write samples to .npz (any samples) or .exr (sorted by pixel); whole or not at all."""
    if _suffix(path) == ".npz":
        arrays: dict[str, Any] = {name: getattr(samples, name) for name in CHANNELS}
        with atomic_path(path) as temporary:
            np.savez_compressed(temporary, version=VERSION, width_px=samples.width_px, height_px=samples.height_px, **arrays)
    else:
        write_exr(path, _parts(samples))


def read_samples(path: Path | str) -> LightFieldSamples:
    """Read samples from .npz or .exr. Raises InputError if the file is missing, damaged or holds something else."""
    if _suffix(path) == ".npz":
        return _read_npz(Path(path))
    parts = sorted((part for part in read_exr(path) if part.name.startswith("sample")), key=lambda part: part.name)
    if not parts:
        raise InputError(f"{path} holds no light field samples: expected parts named sample00, sample01, ...")
    return _from_parts(parts, path)


def _suffix(path: Path | str) -> str:
    suffix = Path(path).suffix.lower()
    if suffix not in _SUFFIXES:
        raise InputError(f"light field samples are kept in .npz or .exr files, got {path}")
    return suffix


def _read_npz(path: Path) -> LightFieldSamples:
    require_file(path, "light field samples")
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            held = {name: archive[name] for name in archive.files}
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path} cannot be read as a NumPy archive: {error}") from None
    except Exception as error:  # zipfile and zlib raise errors of their own on a file that was cut short
        raise InputError(f"{path} is damaged: {error}") from None
    missing = [name for name in ("version", "width_px", "height_px", *CHANNELS) if name not in held]
    if missing:
        raise InputError(f"{path} holds no light field samples: {missing} are missing, it has {sorted(held)}")
    if int(held["version"]) != VERSION:
        raise InputError(f"{path} has version {int(held['version'])} of light field samples, this program reads {VERSION}: update it")
    arrays = {name: held[name].astype(np.float32) for name in CHANNELS}
    return LightFieldSamples(int(held["width_px"]), int(held["height_px"]), **arrays)


def _parts(samples: LightFieldSamples) -> list[ExrPart]:
    """Return parts, of which part k holds the k-th sample of each pixel, in the order in which they come."""
    x, y = samples.pixels()
    place = y * samples.width_px + x
    order = np.argsort(place, kind="stable")
    place = place[order]
    rank = np.arange(samples.count) - np.searchsorted(place, place)
    parts = []
    for k in range(int(rank.max()) + 1):
        here, where = order[rank == k], np.unravel_index(place[rank == k], (samples.height_px, samples.width_px))
        channels = {}
        for name, letters in CHANNELS.items():
            values = getattr(samples, name)[here].reshape(len(here), -1)
            for c, letter in enumerate(letters):
                channels[letter] = np.zeros((samples.height_px, samples.width_px), np.float32)
                channels[letter][where] = -values[:, c] if letter == _UPWARDS else values[:, c]
        parts.append(ExrPart(channels, f"sample{k:02d}"))
    return parts


def _from_parts(parts: list[ExrPart], path: Path | str) -> LightFieldSamples:
    """Return samples pixel by pixel, those of one pixel one after the other."""
    sizes = {part.stacked(("Z",)).shape[:2] for part in parts}
    if len(sizes) > 1:
        raise InputError(f"the parts of {path} must be of one size, but are {sorted(sizes)} (height, width)")
    height_px, width_px = sizes.pop()
    held = np.stack([part.stacked(("Z",))[..., 0] for part in parts], axis=2) != 0
    arrays = {}
    for name, letters in CHANNELS.items():
        values = np.stack([part.stacked(letters) for part in parts], axis=2)[held]
        values = values * np.array([-1.0 if letter == _UPWARDS else 1.0 for letter in letters], np.float32)
        arrays[name] = values if len(letters) > 1 else values[:, 0]
    arrays["rgb"] = in_rec709(arrays["rgb"], stated_primaries(parts[0], parts), path)
    return LightFieldSamples(width_px, height_px, **arrays)
