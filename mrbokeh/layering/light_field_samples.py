"""LightFieldSamples: what a stochastic renderer saw along single rays through the lens and the shutter; in .npz or multi-part OpenEXR.

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

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.images.exr_io import ExrPart, in_rec709, read_exr, stated_primaries
from mrbokeh.optics.lens import Lens
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
UPWARDS = "forward.v"
_SUFFIXES = (".npz", ".exr")
_WIDEST_PUPIL = 2.0


@dataclass(frozen=True)
class LightFieldSamples:
    """N samples of the light field of one picture, in any order.

    xy_px: (N, 2) where the ray met the sensor, within the picture; the centre of the top left pixel is (0.5, 0.5).
    lens_uv: (N, 2) where it passed the pupil, in the unit pupil (x right, y down). time: (N,) in the shutter, 0 to 1.
    rgb: (N, 3) scene-linear light, unclipped. depth_m: (N,) of what the ray met, inf is background.
    motion_px: (N, 2) how far what it met moves over the picture while the shutter is open.
    What is seen from the middle of the pupil at half time at x0 appears at x0 + coc/2 uv + motion (time - 1/2), with the
    signed circle of confusion of `mrbokeh.optics.lens`. Within a pixel, samples spread evenly over area, pupil and shutter.
    """

    width_px: int
    height_px: int
    xy_px: Float32[np.ndarray, "samples 2"]
    lens_uv: Float32[np.ndarray, "samples 2"]
    time: Float32[np.ndarray, " samples"]
    rgb: Float32[np.ndarray, "samples 3"]
    depth_m: Float32[np.ndarray, " samples"]
    motion_px: Float32[np.ndarray, "samples 2"]

    def __post_init__(self) -> None:
        _check_shapes(self)
        for name in ("xy_px", "lens_uv", "time", "rgb", "motion_px"):
            if not np.isfinite(getattr(self, name)).all():
                raise InputError(f"{name} of light field samples must be finite numbers, but some are NaN or infinite")
        if not (self.depth_m > 0).all():
            raise InputError("depth_m of light field samples must be positive metres (inf: background), but some are 0, negative or NaN")
        if (self.xy_px < 0).any() or (self.xy_px > (self.width_px, self.height_px)).any():
            raise InputError(
                f"light field samples must lie within the picture of {self.width_px} x {self.height_px} px, but x, y reach from "
                f"{self.xy_px.min(axis=0).tolist()} to {self.xy_px.max(axis=0).tolist()}: give them in pixels from its top left corner"
            )
        if (self.time < 0).any() or (self.time > 1).any():
            raise InputError(
                f"the time of light field samples counts from 0 (shutter opens) to 1 (it closes), but reaches from "
                f"{self.time.min():g} to {self.time.max():g}: divide it by the exposure"
            )
        if (np.abs(self.lens_uv) > _WIDEST_PUPIL).any():
            raise InputError(
                f"lens_uv of light field samples lies in the unit pupil, but reaches "
                f"{np.abs(self.lens_uv).max():g}: divide it by the pupil's radius"
            )

    @property
    def count(self) -> int:
        return len(self.time)

    @property
    def per_pixel(self) -> float:
        """Mean number of samples of a pixel (spp)."""
        return self.count / (self.width_px * self.height_px)

    def coc_px(self, lens: Lens) -> Float32[np.ndarray, " samples"]:
        """Return the signed circle of confusion of what each sample met; if the focus is tilted or curved, by the focus at the sample's
        pixel.
        """
        if lens.has_flat_focus:
            return lens.coc_px(self.depth_m, self.width_px).astype(np.float32)
        x, y = self.pixels()
        in_focus = lens.focus_dioptres(self.width_px, self.height_px)[y, x]
        return (lens.coc_px_per_dioptre(self.width_px) * (in_focus - 1.0 / self.depth_m)).astype(np.float32)

    def pixels(self) -> tuple[np.ndarray, np.ndarray]:
        """Return column and row of the pixel of each sample; the far border belongs to the last."""
        x, y = np.floor(self.xy_px).astype(np.int64).T
        return np.minimum(x, self.width_px - 1), np.minimum(y, self.height_px - 1)

    def positions_at_lens_centre_px(self, lens: Lens) -> Float32[np.ndarray, "samples 2"]:
        """Reproject to (u, v, t) = (0, 0, 1/2): return where the middle of the pupil sees, at half time, what each sample met."""
        moved = self.motion_px * (self.time - 0.5)[:, None]
        return self.xy_px - 0.5 * self.coc_px(lens)[:, None] * self.lens_uv - moved

    def raw_picture(self) -> Float32[np.ndarray, "height width 3"]:
        """Return the mean of the samples of each pixel, noise and all; 0 where a pixel has none."""
        x, y = self.pixels()
        place = y * self.width_px + x
        size = self.width_px * self.height_px
        counts = np.bincount(place, minlength=size)
        sums = np.stack([np.bincount(place, self.rgb[:, c], size) for c in range(3)], axis=-1)
        return (sums / np.maximum(counts, 1)[:, None]).reshape(self.height_px, self.width_px, 3).astype(np.float32)


def joined(parts: "list[LightFieldSamples]") -> LightFieldSamples:
    """Join several sets of samples of one picture."""
    if not parts:
        raise InputError("nothing to join: expected at least one set of light field samples, got none")
    sizes = {(part.width_px, part.height_px) for part in parts}
    if len(sizes) > 1:
        raise InputError(f"light field samples can be joined only where they are of one picture, but the sizes are {sorted(sizes)}")
    names = ("xy_px", "lens_uv", "time", "rgb", "depth_m", "motion_px")
    return LightFieldSamples(*sizes.pop(), *(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _check_shapes(samples: LightFieldSamples) -> None:
    if samples.width_px < 1 or samples.height_px < 1:
        raise InputError(f"light field samples need the size of their picture, got {samples.width_px} x {samples.height_px} px")
    count: Float[np.ndarray, "..."] = samples.time
    expected = {"xy_px": (2,), "lens_uv": (2,), "time": (), "rgb": (3,), "depth_m": (), "motion_px": (2,)}
    wrong = {name: getattr(samples, name).shape for name, rest in expected.items() if getattr(samples, name).shape != (count.size, *rest)}
    if wrong:
        raise InputError(
            f"light field samples need xy_px, lens_uv, motion_px (N, 2), rgb (N, 3), "
            f"time, depth_m (N,), but with N = {count.size} came {wrong}"
        )
    if count.size == 0:
        raise InputError("light field samples hold no sample: expected at least one")


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
        values = values * np.array([-1.0 if letter == UPWARDS else 1.0 for letter in letters], np.float32)
        arrays[name] = values if len(letters) > 1 else values[:, 0]
    arrays["rgb"] = in_rec709(arrays["rgb"], stated_primaries(parts[0], parts), path)
    return LightFieldSamples(width_px, height_px, **arrays)
