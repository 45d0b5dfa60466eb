"""How wide the blur is around points of known depth: the disc that turns the all-in-focus picture into the slice.

Around each point the all-in-focus picture, blurred by openings of growing diameter, is held against the slice; the diameter that
fits best is the point's circle of confusion.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int

from mrbokeh.optics.aperture import Aperture

MOST_BLUR_PX = 14.0

_DIAMETERS_PX = np.arange(1.5, MOST_BLUR_PX + 1.01, 0.5)
WINDOW_PX = 19
_WELL_MATCHED = 0.2
_PIXEL_IN_DISC_PX2 = 4.0 / 3.0

Plane = Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class BlurSamples:
    """Diameters of circles of confusion, measured. slices, points: indices of each; diameter_px: in the registered slice."""

    slices: Int[np.ndarray, " samples"]
    points: Int[np.ndarray, " samples"]
    diameter_px: Float[np.ndarray, " samples"]


def measure_blur(all_in_focus: Plane, slices: Iterable[Plane], xy_px: Float[np.ndarray, "points 2"], aperture: Aperture) -> BlurSamples:
    """all_in_focus, slices: luminance in one geometry. Only what fits well and lies between 2 and 14 px is returned."""
    blurred = [_blurred(all_in_focus, diameter, aperture) for diameter in _DIAMETERS_PX]
    found: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []
    for index, plane in enumerate(slices):
        diameters = best_diameters(plane, all_in_focus, blurred, xy_px)
        told = np.flatnonzero(np.isfinite(diameters))
        found.append((np.full(len(told), index), told, diameters[told]))
    return BlurSamples(*(np.concatenate(columns) for columns in zip(*found, strict=True)))


def best_diameters(
    plane: Plane, sharp: Plane, blurred: Sequence[Plane], xy_px: Float[np.ndarray, "points 2"]
) -> Float[np.ndarray, " points"]:
    """Diameter of the blur nearest to the slice around each point; NaN where none is much nearer than no blur.

    A rasterized opening takes in the pixel's own square, which the sharp picture has once already. A disc of diameter c has
    the variance c^2 / 16 along an axis, a pixel 1/12, so what fits as c is sqrt(c^2 + 4/3).
    """
    places = (xy_px - 0.5).astype(np.float32)
    unlike = np.array([_unlike(each, plane, places) for each in blurred])
    lowest = np.argmin(unlike, axis=0)
    inside = np.clip(lowest, 1, len(blurred) - 2)
    columns = np.arange(len(places))
    before, at, after = (unlike[inside + step, columns] for step in (-1, 0, 1))
    bend = before - 2.0 * at + after
    shift = np.divide(0.5 * (before - after), bend, out=np.zeros_like(bend), where=bend > 0)
    fitted_px = _DIAMETERS_PX[inside] + (_DIAMETERS_PX[1] - _DIAMETERS_PX[0]) * shift
    good = (lowest == inside) & (np.abs(shift) <= 1.0) & (at < _WELL_MATCHED * _unlike(sharp, plane, places))
    return np.where(good, np.sqrt(fitted_px**2 + _PIXEL_IN_DISC_PX2), np.nan)


def _blurred(picture: Plane, diameter_px: float, aperture: Aperture) -> Plane:
    kernel = aperture.rasterize(float(diameter_px)).kernel.astype(np.float32)
    return cv2.filter2D(picture, -1, kernel, borderType=cv2.BORDER_REFLECT_101)


def _unlike(a: Plane, b: Plane, places: Float32[np.ndarray, "points 2"]) -> Float[np.ndarray, " points"]:
    """Variance of the difference within a window: a constant that leaks in from beyond it does not count."""
    difference = a - b
    size = (WINDOW_PX, WINDOW_PX)
    variance = cv2.blur(difference**2, size) - cv2.blur(difference, size) ** 2
    sampled = cv2.remap(np.maximum(variance, 0.0), places[:, 0], places[:, 1], cv2.INTER_LINEAR)
    return sampled.ravel().astype(np.float64)
