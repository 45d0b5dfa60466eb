"""The true energy of lights that the sensor could not hold, read from the slices in which they are out of focus.

A light in focus saturates a few pixels and its radiance is lost. Out of focus the same energy lies spread over its disc,
below the saturation. Its flux there, less the background, is what the sharp pixels should have held.
"""

from collections.abc import Iterable

import numpy as np
from jaxtyping import Bool, Float, Float32, Int

from capture.merging.lights import Lights

Rgb = Float32[np.ndarray, "height width 3"]

CORE_SHARE = 0.7


def with_light_energy(merged: Rgb, slices: Iterable[Rgb], lights: Lights) -> Rgb:
    """The all-in-focus picture with every light's flux raised to what the slice shows in which it is spread widest."""
    if len(lights) == 0:
        return merged
    background = _background(merged, lights)
    held = _flux(merged - background, lights)
    seen = np.stack([_flux(rgb - background, lights) for rgb in slices])
    missing = np.maximum(seen[lights.widest, np.arange(len(lights))] - held, 0.0)
    core = _brightest(merged, lights)
    pixels = np.bincount(lights.zone[core], minlength=len(lights) + 1)[1:]
    share = np.concatenate([np.zeros((1, 3)), missing / np.maximum(pixels, 1)[:, None]])
    restored = merged.copy()
    restored[core] += share[lights.zone[core]].astype(np.float32)
    return restored


def _flux(excess: Rgb, lights: Lights) -> Float[np.ndarray, "lights 3"]:
    """Sum of the light over its zone, per channel."""
    count = len(lights) + 1
    return np.stack([np.bincount(lights.zone.ravel(), excess[..., c].ravel(), count)[1:] for c in range(3)], axis=1)


def _background(merged: Rgb, lights: Lights) -> Rgb:
    """The merged picture with each light and its rim replaced by the mean of the rest of its zone."""
    from scipy.ndimage import binary_dilation

    lit = binary_dilation(lights.core, iterations=2)
    count = len(lights) + 1
    around = (lights.zone > 0) & ~lit
    pixels = np.maximum(np.bincount(lights.zone[around], minlength=count), 1)
    means = np.stack([np.bincount(lights.zone[around], merged[around][:, c], count) / pixels for c in range(3)], axis=1)
    replaced = lit & (lights.zone > 0)
    result = merged.copy()
    result[replaced] = means[lights.zone[replaced]].astype(np.float32)
    return result


def _brightest(merged: Rgb, lights: Lights) -> Bool[np.ndarray, "height width"]:
    """The pixels of each light that come near its maximum: those that saturated."""
    brightness = merged.max(axis=2)
    peaks = np.zeros(len(lights) + 1, np.float32)
    zone: Int[np.ndarray, "height width"] = lights.zone
    np.maximum.at(peaks, zone.ravel(), brightness.ravel())
    return (zone > 0) & lights.core & (brightness >= CORE_SHARE * peaks[zone])
