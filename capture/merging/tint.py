"""Gain and tint of slices brought to those of the reference: one number per slice and colour.

Lamps warm up, and cameras set exposure and white balance anew. Blur moves light around and conserves it, so that means over large areas are
compared, neighbour by neighbour. A field in place of a number is not fitted: over a whole frame the light that blur carries across depth
edges looks like shading (up to 16 % at the corners of a circuit board whose neighbours differ by less than 1 %).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from capture.merging.plane_transforms import Transform, at_scale
from capture.merging.track_fit import robust_weights
from capture.merging.warping import sampled

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Gains = Float[np.ndarray, "slices 3"]

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


def tint_gains(slices: Sequence[SmallSlice], reference_from_slice: Sequence[Transform], reference: int) -> Gains:
    """Return what each slice is to be multiplied with, 1 for all where none leaves the dead zone."""
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
