"""Focus energies of all slices of a stack, at a size that fits into memory."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Volume = Float32[np.ndarray, "slices height width"]

# The window of the energy is wide enough that every second pixel holds all of it.
LEAST_SHRINK = 2
LARGEST_VOLUME_BYTES = 300e6
# Where the strongest energy of a pixel is this many times that of noise, its slices need no averaging.
CALM_NOISE_FLOORS = 1000.0


@dataclass(frozen=True)
class FocusVolume:
    """energies (slices, h, w): local energy of fine detail in every slice. shape: (H, W) of the pictures, h = ceil(H / shrink)."""

    energies: Volume
    shape: tuple[int, int]

    @property
    def floor(self) -> float:
        return noise_floor(self.energies)

    def calmed(self) -> Volume:
        """Energies with the noise of single slices averaged out where it matters: weights 1, 2, 1 along the slices.

        Noise is new in every slice, detail is not. Where detail stands far above the noise the peak is kept as it is.
        """
        strongest = self.energies.max(axis=0)
        share = np.float32(0.25) * (1.0 - share_above(strongest, CALM_NOISE_FLOORS * self.floor))
        result = np.empty_like(self.energies)
        last = len(self.energies) - 1
        for index, energy in enumerate(self.energies):
            before, after = self.energies[max(index - 1, 0)], self.energies[min(index + 1, last)]
            result[index] = energy + share * (before + after - 2.0 * energy)
        return result

    def reduced(self, plane: np.ndarray) -> np.ndarray:
        """A picture of the stack's size at the size of the volume, every pixel being one of its own."""
        rows, columns = (
            np.minimum((np.arange(n) + 0.5) * full / n, full - 1).astype(int) for n, full in zip(self.size, self.shape, strict=True)
        )
        return plane[np.ix_(rows, columns)]

    def enlarged(self, plane: Plane, largest_step: float = np.inf) -> Float32[np.ndarray, "full_height full_width"]:
        """A plane of the volume at the stack's size: bilinear, but nearest where neighbours differ by more than `largest_step`."""
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
    """The focus energies of registered slices, which are read once; where a slice has no data it has no energy.

    count: how many slices there will be, for the memory they take.
    """
    energies: list[Plane] = []
    for index, rgb in enumerate(registered):
        energy = focus_energy(rgb)
        if valid is not None:
            energy[~valid(index)] = 0.0
        height, width = _reduced_size(energy.shape, count)
        energies.append(cv2.resize(energy, (width, height), interpolation=cv2.INTER_AREA))
    return FocusVolume(np.stack(energies), (rgb.shape[0], rgb.shape[1]))


def focus_energy(rgb: Rgb, window_px: float = 2.5) -> Plane:
    """Local energy of fine detail (sum of squared Laplacians), in the square root of light where shot noise is even."""
    encoded = cv2.GaussianBlur(np.sqrt(np.maximum(rgb, 0.0)), (0, 0), 0.7)
    detail = cv2.Laplacian(encoded, cv2.CV_32F, ksize=1)
    red, green, blue = cv2.split(cv2.multiply(detail, detail, dst=detail))
    return cv2.GaussianBlur(cv2.add(cv2.add(red, green, dst=red), blue, dst=red), (0, 0), window_px)


def noise_floor(energies: Volume) -> float:
    """The focus energy that noise alone has: what the smoothest places of the least sharp slice show."""
    return float(np.percentile(energies.min(axis=0), 5)) + 1e-9


def share_above(energy: Plane, half_at: float) -> Plane:
    """From 0 to 1 with the energy, one half at `half_at`."""
    return (energy / (energy + np.float32(half_at))).astype(np.float32)


def _reduced_size(shape: tuple[int, ...], count: int) -> tuple[int, int]:
    shrink = LEAST_SHRINK
    while 4.0 * count * shape[0] * shape[1] / shrink**2 > LARGEST_VOLUME_BYTES:
        shrink += 1
    return -(-shape[0] // shrink), -(-shape[1] // shrink)
