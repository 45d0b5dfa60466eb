"""Slices as ingested, and resampled to the geometry of the reference: written once, read again in as many passes as merging needs.

Gain and tint of slices are brought to those of the reference, by one number per slice and colour. Light sources warm up, and cameras set
exposure and white balance anew. Blur moves light around and conserves it, so means over large areas are compared, neighbour by neighbour.
A field in place of a number is not fitted: over a whole frame the light that blur carries across depth edges looks like shading (up to
16 % at the corners of a circuit board whose neighbours differ by less than 1 %).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float16, Float32

from capture.merging.registration.corner_tracks import robust_weights
from capture.merging.registration.plane_transforms import Transform, at_scale, sampled, warp, warped_validity
from capture.merging.registration.registration_file import FILE_NAME as REGISTRATION_NAME
from capture.merging.registration.registration_file import Registration
from mrbokeh.images.camera_rgb import SATURATED, half_of, single_of, write_camera_rgb
from mrbokeh.images.exr_io import read_exr
from mrbokeh.stacks.focal_stack import FocalStack, Slice
from mrbokeh.system.errors import InputError

DEAD_ZONE = 0.02
"""A stack whose slices all differ by less than this share of the light stays: codes, noise and blur do as much, and nobody sees it."""
LARGEST_SCATTER = 0.02
"""Neighbours whose large areas differ by more than this beside the number do not tell it."""
_LONG_SIDE_PX = 64
_SIGMA_PX = 2.5
_DARKEST = 0.008
"""Below it codes are too coarse and blacks too far from zero to tell a share of the light."""
_NEARLY_FULL, _FULL = 0.85, 0.98
_LARGEST_SATURATED_SHARE = 0.02
_FEWEST_PIXELS = 400
_ROUNDS = 10
_LEAST_SCATTER = 1e-3
REGISTERED_FOLDER = "registered"
LARGEST_HELD_BYTES = 256e6
_LARGEST_HALF = np.float32(np.finfo(np.float16).max)
_GAIN_ATTRIBUTE = "mrbokehTintGain"

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Gains = Float[np.ndarray, "slices 3"]
Half = Float16[np.ndarray, "height width 3"]
Stored = Float[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class SmallSlice:
    """A slice as it was ingested, at the size of large areas: mean light (rows, columns, 3), and the share of them that was full."""

    light: Float32[np.ndarray, "rows columns 3"]
    full: Float32[np.ndarray, "rows columns"]
    shrink: float

    @classmethod
    def of(cls, rgb: Rgb, saturated: Plane) -> "SmallSlice":
        shrink = max(rgb.shape[:2]) / _LONG_SIDE_PX
        size = (max(8, round(rgb.shape[1] / shrink)), max(8, round(rgb.shape[0] / shrink)))
        light, full = (cv2.resize(each, size, interpolation=cv2.INTER_AREA) for each in (rgb, saturated))
        return cls(light, full, shrink)


@dataclass
class IngestedSlices:
    """Slices of a stack as they were ingested. Those of a small stack are read once and held as their files are."""

    stack: FocalStack
    _held: dict[Path, tuple[Stored, Plane | None]] = field(default_factory=dict)
    _small: dict[Path, SmallSlice] = field(default_factory=dict)
    _buffer: Rgb | None = None

    def read(self, path: Path) -> tuple[Rgb, Plane]:
        """Return (camera RGB, share of each pixel that was full) of a file of the stack; the colours hold until the next call."""
        if path not in self._held:
            stored, saturated = _stored_slice(path)
            if stored.nbytes * len(self.stack) <= LARGEST_HELD_BYTES:
                self._held[path] = stored, saturated if saturated.any() else None
            rgb = self._single(stored)
            self._small[path] = SmallSlice.of(rgb, saturated)
            return rgb, saturated
        rgb, held = self._held[path]
        return self._single(rgb), np.zeros(rgb.shape[:2], np.float32) if held is None else held

    def _single(self, stored: Stored) -> Rgb:
        if stored.dtype != np.float16:
            return stored.copy()
        # Memory that is new costs more than what is written into it.
        self._buffer = single_of(stored, self._buffer)
        return self._buffer

    def small(self, path: Path) -> SmallSlice:
        """Return what is left of a slice at the size of large areas; it is read if it was not before."""
        if path not in self._small:
            self.read(path)
        return self._small[path]

    def read_last(self, path: Path) -> tuple[Rgb, Plane]:
        """Return what `read` does, for the last time."""
        found = self.read(path)
        self._held.pop(path, None)
        return found


@dataclass
class RegisteredSlices:
    """Slices of a stack in the geometry of its reference, as files in `registered/`, with the gain and tint of the reference.

    A small stack is held in memory as half floats, as the files are, so that further passes read nothing.
    saturated: (H, W) full in some slice, once all have been made.
    """

    stack: FocalStack
    registration: Registration
    ingested: IngestedSlices
    saturated: Mask | None = None
    _valid: tuple[int, Mask] | None = None
    _held: list[Half] = field(default_factory=list)
    _buffer: Rgb | None = None

    def resampled(self, keep: bool) -> Iterator[Rgb]:
        """Resample and write every slice, and give it; its colours hold until the next.

        keep: a file that is newer than slice and registration is read instead.
        """
        for index, each in enumerate(self.stack.slices):
            path, sources = self.path(index), (self.stack.folder / source_path(each), self.stack.folder / REGISTRATION_NAME)
            kept = keep and newer(path, *sources) and self._has_gain(path, index)
            half, saturated = self._kept(path) if kept else self._resampled(index)
            self._remember(half, saturated)
            if not kept:
                self._write(index, half, saturated)
            yield self._single(half)

    def _write(self, index: int, half: Half, saturated: Plane) -> None:
        gain = {_GAIN_ATTRIBUTE: str(self.tint_gains[index].tolist())}
        write_camera_rgb(
            self.path(index), half, self.stack.rec709_from_camera, saturated=saturated, valid=self.valid(index), attributes=gain
        )

    def _has_gain(self, path: Path, index: int) -> bool:
        """Return whether a file of an earlier run was made with the gain that its slice has now."""
        return read_exr(path)[0].attributes.get(_GAIN_ATTRIBUTE) == str(self.tint_gains[index].tolist())

    def stored(self) -> Iterator[Rgb]:
        """Yield the slices once more, after they were all made; the colours of one hold until the next."""
        for index in range(len(self.stack)):
            yield self._single(self._held[index] if self._held else self._kept(self.path(index))[0])

    def _single(self, half: Half) -> Rgb:
        self._buffer = single_of(half, self._buffer)
        return self._buffer

    def valid(self, index: int) -> Mask:
        """Return (H, W) where a slice has data, once the first has been made."""
        if self._valid is None or self._valid[0] != index:
            assert self.saturated is not None, "a slice was made, so that its size is known"
            height, width = self.saturated.shape
            self._valid = (index, warped_validity((height, width), self.registration.reference_from_slice[index]))
        return self._valid[1]

    def require_size(self) -> None:
        """Raise InputError if the registration is of pictures of another size."""
        rgb = self.ingested.read(self.stack.folder / source_path(self.stack.slices[0]))[0]
        size_px = (rgb.shape[1], rgb.shape[0])
        if self.registration.size_px not in (None, size_px):
            raise InputError(
                f"the registration is for pictures of {self.registration.size_px} px, but the slices of {self.stack.folder} have "
                f"{size_px}: leave --registration out, and the slices are registered anew"
            )

    def path(self, index: int) -> Path:
        return self.stack.folder / REGISTERED_FOLDER / f"{index:02d}.exr"

    def descriptions(self) -> tuple[Slice, ...]:
        """Return the entries of the registered slices for stack.json."""
        return tuple(
            replace(
                each,
                path=f"{REGISTERED_FOLDER}/{index:02d}.exr",
                scale=self.registration.scales[index],
                metadata=each.metadata
                | {
                    "ingested": source_path(each),
                    "reference_from_slice": self.registration.reference_from_slice[index].tolist(),
                    "tint_gain": self.tint_gains[index].tolist(),
                },
            )
            for index, each in enumerate(self.stack.slices)
        )

    def _kept(self, path: Path) -> tuple[Half, Plane]:
        """Return a resampled slice of an earlier run, or of an earlier pass of this one."""
        stored, saturated = _stored_slice(path)
        return np.asarray(stored, np.float16), saturated

    def _resampled(self, index: int) -> tuple[Half, Plane]:
        rgb, saturated = self.ingested.read_last(self.stack.folder / source_path(self.stack.slices[index]))
        transform, gain = self.registration.reference_from_slice[index], self.tint_gains[index]
        lit = partial(with_gain, gain=gain) if (gain != 1.0).any() else None
        moved = warp(rgb, transform, lit)
        # Half float keeps 11 bits, far below the noise of a photograph. Rounded at once, a resumed run gives the same.
        return half_of(np.minimum(moved, _LARGEST_HALF, out=moved)), _warped_share(saturated, transform)

    @cached_property
    def tint_gains(self) -> Gains:
        """Return (slices, 3) the factors for the light of each slice."""
        small = [self.ingested.small(self.stack.folder / source_path(each)) for each in self.stack.slices]
        return tint_gains(small, self.registration.reference_from_slice, self.registration.reference)

    def _remember(self, half: Half, saturated: Plane) -> None:
        full = saturated > 0
        self.saturated = full if self.saturated is None else self.saturated | full
        if half.nbytes * len(self.stack) <= LARGEST_HELD_BYTES:
            self._held.append(half)


def source_path(each: Slice) -> str:
    """Return the path of the slice as it was ingested, also after registration has put a resampled one in its place."""
    return str(each.metadata.get("ingested", each.path))


def newer(path: Path, *sources: Path) -> bool:
    """Return whether a file is there and was written after all that it is made of."""
    return path.is_file() and all(path.stat().st_mtime_ns >= source.stat().st_mtime_ns for source in sources)


def tint_gains(slices: Sequence[SmallSlice], reference_from_slice: Sequence[Transform], reference: int) -> Gains:
    """Return the factor for each slice and colour, 1 for all where none leaves the dead zone."""
    areas = [_areas(small, transform) for small, transform in zip(slices, reference_from_slice, strict=True)]
    steps = np.array([_step(one, other) for one, other in pairwise(areas)]).reshape(-1, 3)
    logarithms = np.vstack([np.zeros((1, 3)), np.cumsum(steps, axis=0)])
    logarithms -= logarithms[reference]
    return np.exp(logarithms) if np.abs(logarithms).max() > DEAD_ZONE else np.ones_like(logarithms)


def with_gain(rgb: Rgb, gain: Float[np.ndarray, "3"]) -> Rgb:
    """Return a slice with its gain, which fades out towards what fills the sensor: full is full, and white stays white."""
    planes = cv2.split(rgb)
    share = cv2.max(cv2.max(planes[0], planes[1]), planes[2])
    np.subtract(np.float32(_FULL), share, out=share)
    np.multiply(share, np.float32(1.0 / (_FULL - _NEARLY_FULL)), out=share)
    np.clip(share, 0.0, 1.0, out=share)
    for each, factor in zip(planes, gain, strict=True):
        cv2.scaleAdd(cv2.multiply(each, share), float(factor) - 1.0, each, dst=each)
    return cv2.merge(planes)


def _areas(small: SmallSlice, transform: Transform) -> tuple[Rgb, Bool[np.ndarray, "rows columns"]]:
    """Return logarithms of light over large areas in the geometry of the reference, and which are known and not full."""
    size = small.full.shape[::-1]
    smaller = at_scale(transform, 1.0 / small.shrink)
    light = sampled(small.light, smaller, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    full = sampled(small.full, smaller, size, flags=cv2.INTER_LINEAR, borderValue=1.0)
    light = cv2.GaussianBlur(light, (0, 0), _SIGMA_PX)
    usable = (light > _DARKEST).all(axis=2) & (cv2.dilate(full, np.ones((3, 3), np.uint8)) < _LARGEST_SATURATED_SHARE)
    return np.log(np.maximum(light, np.float32(_DARKEST))), usable


def _step(one: tuple[Rgb, Bool[np.ndarray, "rows columns"]], other: tuple[Rgb, Bool[np.ndarray, "rows columns"]]) -> Float[np.ndarray, "3"]:
    """Return the logarithms of what brings the light of a slice to that of the one before it.

    0 where one of the colours does not tell: two slices then stay to one another as they are, and no tint is made.
    """
    both = one[1] & other[1]
    if both.sum() < _FEWEST_PIXELS:
        return np.zeros(3)
    found = [_robust_mean(each) for each in (one[0] - other[0])[both].T]
    told = all(scatter <= LARGEST_SCATTER for _, scatter in found)
    return np.array([mean for mean, _ in found]) if told else np.zeros(3)


def _robust_mean(values: Float32[np.ndarray, " cells"]) -> tuple[float, float]:
    """Return a mean that outliers do not move (Geman and McClure 1985), and the scatter about it."""
    mean, scatter = float(np.median(values)), _LEAST_SCATTER
    for _ in range(_ROUNDS):
        scatter = max(1.4826 * float(np.median(np.abs(values - mean))), _LEAST_SCATTER)
        mean = float(np.average(values, weights=robust_weights(np.abs(values - mean), scatter)))
    return mean, scatter


def _stored_slice(path: Path) -> tuple[Stored, Plane]:
    """Return (camera RGB as the file has it, mostly in half floats; share of each pixel that was full) of one file, read once."""
    part = read_exr(path)[0]
    rgb = cv2.merge(part.planes("RGB"))
    return rgb, single_of(part.channels[SATURATED]) if SATURATED in part.channels else np.zeros(rgb.shape[:2], np.float32)


def _warped_share(saturated: Plane, reference_from_slice: Transform) -> Plane:
    if not saturated.any():
        return saturated
    size = (saturated.shape[1], saturated.shape[0])
    return sampled(saturated, reference_from_slice, size, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
