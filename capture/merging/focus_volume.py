"""Focus energies of all slices of a stack, in multiples of the noise, at a size that fits into memory."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import reduce

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from capture.stacks.slice_looks import block_means, detail_of_blocks

_LAPLACIAN = np.array([[0, 1, 0], [1, -4, 1], [0, 1, 0]], np.float32)
# The window of the energy is wide enough that every second pixel holds all of it.
LEAST_SHRINK = 2
LARGEST_VOLUME_BYTES = 300e6
# Where the strongest energy of a pixel is this many times that of noise, its slices need no averaging.
CALM_NOISE_FLOORS = 1000.0
# Noise is measured at so many brightnesses, each on at least so many pixels, as a low percentile of their energies.
_LEVELS = 24
_WHITE = 255.0
_FEWEST_PIXELS = 200
_NOISE_PERCENTILE = 5.0
_EVERY_PX = 3
# Near black and white codes are crushed and clipped: what little noise is left there is no measure of certainty.
_LEAST_OF_MEDIAN = 0.25

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Volume = Float32[np.ndarray, "slices height width"]
Blocks = Float32[np.ndarray, "rows columns"]
Light = UInt8[np.ndarray, "height width"]


@dataclass(frozen=True)
class FocusVolume:
    """Focus energies of a stack.

    energies (slices, h, w): local energy of fine detail in every slice, with the noise of the noisiest of the place, over that noise.
    noise (h, w): that noise, as `focus_energy`. lights (slices, h, w): mean over the channels of the square root of light, 255 at display
    white. shape: (H, W) of the pictures, h = ceil(H / shrink). details: of every slice, by blocks (`block_detail`), 0 in blocks that lack
    data. missing (slices, h, w): where a slice has no data and another has; None where all have.
    """

    energies: Volume
    noise: Plane
    lights: UInt8[np.ndarray, "slices height width"]
    shape: tuple[int, int]
    details: tuple[Blocks, ...]
    missing: Bool[np.ndarray, "slices height width"] | None = None

    def calmed(self) -> Volume:
        """Return energies with the noise of single slices averaged out where it matters: weights 1, 2, 1 along the slices.

        Noise is new in every slice, detail is not. Where detail stands far above the noise the peak is kept as it is.
        """
        strongest = self.energies.max(axis=0)
        share = np.float32(0.25) * (1.0 - share_above(strongest, CALM_NOISE_FLOORS))
        result = np.empty_like(self.energies)
        last = len(self.energies) - 1
        for index, energy in enumerate(self.energies):
            before, after = self.energies[max(index - 1, 0)], self.energies[min(index + 1, last)]
            result[index] = energy + share * (before + after - 2.0 * energy)
        if self.missing is not None:
            result[self.missing] = 0.0
        return result

    def without(self, spread: Bool[np.ndarray, "slices height width"]) -> "FocusVolume":
        """Return the volume without the say of some slices at some places, given at the size of the volume."""
        if not spread.any():
            return self
        places = (block_means(self.enlarged(each.astype(np.float32), 0.0)) for each in spread)
        details = tuple(np.where(place > 0, np.float32(0.0), detail) for place, detail in zip(places, self.details, strict=True))
        return replace(self, energies=np.where(spread, np.float32(0.0), self.energies), details=details)

    def reduced(self, plane: np.ndarray) -> np.ndarray:
        """Return a picture of the stack's size at the size of the volume, every pixel being one of its own."""
        rows, columns = (
            np.minimum((np.arange(n) + 0.5) * full / n, full - 1).astype(int) for n, full in zip(self.size, self.shape, strict=True)
        )
        return plane[np.ix_(rows, columns)]

    def enlarged(self, plane: Plane, largest_step: float = np.inf) -> Float32[np.ndarray, "full_height full_width"]:
        """Return a plane of the volume at the stack's size: bilinear, but nearest where neighbours differ by more than `largest_step`."""
        size = (self.shape[1], self.shape[0])
        smooth = cv2.resize(plane, size, interpolation=cv2.INTER_LINEAR)
        if not np.isfinite(largest_step):
            return smooth
        nearest = cv2.resize(plane, size, interpolation=cv2.INTER_NEAREST)
        return np.where(np.abs(smooth - nearest) <= 0.5 * largest_step, smooth, nearest)

    @property
    def size(self) -> tuple[int, int]:
        return self.energies.shape[1], self.energies.shape[2]


def focus_volume(registered: Iterable[Rgb], valid: Callable[[int], Mask] | None = None, count: int = 16) -> FocusVolume:
    """Return the focus energies of registered slices, which are read once; where a slice has no data it has no energy.

    count: how many slices there will be, for the memory they take.
    """
    energies: list[Plane] = []
    lights: list[Light] = []
    levels: list[Light] = []
    details: list[Blocks] = []
    missing: list[Mask] = []
    for index, rgb in enumerate(registered):
        encoded = np.maximum(rgb, 0.0)
        cv2.sqrt(encoded, dst=encoded)
        energy = _energy(encoded)
        details.append(block_detail(encoded))
        height, width = _reduced_size(energy.shape, count)
        if valid is not None:
            outside = ~valid(index)
            energy[outside] = 0.0
            # One pixel more, for choices go over into one another from pixel to pixel.
            share = cv2.resize(outside.astype(np.float32), (width, height), interpolation=cv2.INTER_AREA)
            missing.append(cv2.dilate((share > 0).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
            if outside.any():
                details[-1] = np.where(block_means(outside.astype(np.float32)) > 0, np.float32(0.0), details[-1])
        energies.append(cv2.resize(energy, (width, height), interpolation=cv2.INTER_AREA))
        small = cv2.resize(encoded, (width, height), interpolation=cv2.INTER_AREA)
        lights.append(np.minimum(cv2.transform(small, np.full((1, 3), _WHITE / 3.0)), _WHITE).astype(np.uint8))
        levels.append(np.minimum(cv2.transform(small, np.full((1, 3), _LEVELS / 3.0)), _LEVELS - 1).astype(np.uint8))
    volume = np.stack(energies)
    noise = _as_noisy_as_the_noisiest(volume, levels, noise_floors(volume, levels))
    shape = (rgb.shape[0], rgb.shape[1])
    lacks = np.stack(missing) if any(each.any() for each in missing) else None
    if lacks is not None:
        lacks &= ~lacks.all(axis=0)
        volume[lacks] = 0.0
    return FocusVolume(volume, noise=noise, lights=np.stack(lights), shape=shape, details=tuple(details), missing=lacks)


def focus_energy(rgb: Rgb, window_px: float = 2.5) -> Plane:
    """Return the local energy of fine detail (sum of squared Laplacians), in the square root of light where shot noise is even."""
    return _energy(np.sqrt(np.maximum(rgb, 0.0)), window_px)


def block_detail(encoded: Rgb) -> Blocks:
    """Return the fine detail of a picture in square roots of light by blocks, those at its border included."""
    return detail_of_blocks(cv2.transform(encoded, np.array([[0.2126, 0.7152, 0.0722]])))


def noise_floors(energies: Volume, levels: list[Light]) -> Float32[np.ndarray, " levels"]:
    """Return the energy of noise alone at each brightness (square root of light, in _LEVELS steps), measured in the smoothest places.

    Compression and clipping leave less noise in the dark and at white than in between, by a factor of ten in real JPEG: with one
    floor for all, the noise of a defocused, brighter slice outshouts the sharp slice in the dark.
    """
    every = (slice(None, None, _EVERY_PX),) * 2
    energy = np.concatenate([each[every].ravel() for each in energies])
    level = np.concatenate([each[every].ravel() for each in levels])
    level, energy = level[energy > 0], energy[energy > 0]
    lows = {each: float(np.percentile(energy[level == each], _NOISE_PERCENTILE)) for each in _well_filled(level)}
    if not lows:
        return np.full(_LEVELS, (np.percentile(energy, _NOISE_PERCENTILE) if energy.size else 0.0) + 1e-9, np.float32)
    floors = np.exp(np.interp(np.arange(_LEVELS), list(lows), np.log(np.array(list(lows.values())) + 1e-12)))
    return np.maximum(floors, max(_LEAST_OF_MEDIAN * np.median(list(lows.values())), 1e-9)).astype(np.float32)


def _as_noisy_as_the_noisiest(energies: Volume, levels: list[Light], floors: Float32[np.ndarray, " levels"]) -> Plane:
    """Give each slice the noise that it lacks beside the noisiest one of a place, then divide all by that; 0 stays 0. Return that noise.

    One divisor for all: beside a strong edge noise is nothing, but there a blurred slice may be nearly white, where it has a fifth of the
    noise of the sharp slice, and would win by that.
    """
    largest = reduce(np.maximum, (floors[level] for level in levels))
    for energy, level in zip(energies, levels, strict=True):
        energy += (energy > 0) * (largest - floors[level])
        energy /= largest
    return largest


def share_above(energy: Plane, half_at: float) -> Plane:
    """Return 0 to 1 with the energy, one half at `half_at`."""
    return (energy / (energy + np.float32(half_at))).astype(np.float32)


def _energy(encoded: Rgb, window_px: float = 2.5) -> Plane:
    detail = cv2.filter2D(cv2.GaussianBlur(encoded, (0, 0), 0.7), -1, _LAPLACIAN)  # Five times faster here than cv2.Laplacian.
    squared = cv2.transform(cv2.multiply(detail, detail, dst=detail), np.ones((1, 3)))
    return cv2.GaussianBlur(squared, (0, 0), window_px)


def _well_filled(level: UInt8[np.ndarray, " pixels"]) -> list[int]:
    return np.flatnonzero(np.bincount(level, minlength=_LEVELS) >= _FEWEST_PIXELS).tolist()


def _reduced_size(shape: tuple[int, ...], count: int) -> tuple[int, int]:
    shrink = LEAST_SHRINK
    while 4.0 * count * shape[0] * shape[1] / shrink**2 > LARGEST_VOLUME_BYTES:
        shrink += 1
    return -(-shape[0] // shrink), -(-shape[1] // shrink)
