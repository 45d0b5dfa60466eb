"""What would have to change for a prediction to become the slice: exposure, focus, size of blur, place and magnification.

One linear least squares fit per slice, slice = prediction + sum of change_k * derivative_k: a Gauss-Newton step, exact for small
changes and a lower bound of large ones. Radiance is weighted as photons are noisy (variance grows with the signal) and outliers
lose weight (Huber 1964). Residuals are alike within a neighbourhood, so that standard errors come from how cells of the picture
disagree (the sandwich of Liang and Zeger 1986, with cells as clusters), not from the number of pixels.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]

NAMES = ("exposure", "focus_px", "blur_gain", "shift_x_px", "shift_y_px", "magnification", "softness_px2")
_CELLS = (6, 8)
_ROUNDS = 4
_HUBER = 1.345
_DARK = 0.02
_RIDGE = 1e-6


@dataclass(frozen=True)
class Prediction:
    """A slice as predicted, with every diameter `step_px` smaller, and larger; coc_px: its signed diameters."""

    rgb: Rgb
    less: Rgb
    more: Rgb
    coc_px: Plane
    step_px: float

    @property
    def per_px(self) -> Rgb:
        """How the slice changes for each pixel by which every signed diameter grows, as if its focus were moved."""
        return (self.more - self.less) / np.float32(2.0 * self.step_px)


@dataclass(frozen=True)
class Change:
    """A number and its standard error."""

    value: float
    error: float

    def exceeds(self, limit: float, sigmas: float = 3.0) -> bool:
        """Larger than the limit, and that not by chance."""
        return abs(self.value) > limit and abs(self.value) > sigmas * self.error


@dataclass(frozen=True)
class SliceFit:
    """exposure: share by which the slice is brighter. focus_px: pixels to add to every signed diameter. blur_gain: share by which blur is
    larger. shift_*_px: how far the slice lies right and down of the prediction. magnification: share by which it is enlarged.
    softness_px2: variance by which the slice is softer everywhere; below 0 the all-in-focus picture is soft itself, which would else be
    taken for too much blur.
    """

    exposure: Change
    focus_px: Change
    blur_gain: Change
    shift_x_px: Change
    shift_y_px: Change
    magnification: Change
    softness_px2: Change

    @property
    def changes(self) -> dict[str, Change]:
        return {name: getattr(self, name) for name in NAMES}


def fit_slice(rgb: Rgb, prediction: Prediction, counted: Mask) -> tuple[SliceFit, Rgb]:
    """The changes, and (H, W, 3) the slice minus the prediction so changed.

    counted: (H, W) pixels to fit; where there are none, nothing is known (infinite errors).
    """
    columns = _derivatives(prediction)
    residual = rgb - prediction.rgb
    weight = counted / (_DARK + np.maximum(prediction.rgb.mean(axis=2), 0.0))
    change, errors = np.zeros(len(NAMES)), np.full(len(NAMES), np.inf)
    remaining = residual
    if counted.any():
        for _ in range(_ROUNDS):
            cells = _normal_equations(columns, residual, weight * _huber(remaining, weight, counted))
            change, errors = _solved(*cells)
            remaining = residual - _combined(columns, change)
    return SliceFit(*(Change(float(value), float(error)) for value, error in zip(change, errors, strict=True))), remaining


def _derivatives(prediction: Prediction) -> list[Rgb]:
    """In the order of NAMES."""
    rgb, per_px = prediction.rgb, prediction.per_px
    height, width = rgb.shape[:2]
    down, right = np.gradient(rgb, axis=(0, 1))
    x, y = np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2
    outwards = right * x[None, :, None].astype(np.float32) + down * y[:, None, None].astype(np.float32)
    return [rgb, per_px, per_px * prediction.coc_px[..., None], -right, -down, -outwards, 0.5 * cv2.Laplacian(rgb, cv2.CV_32F)]


def _huber(remaining: Rgb, weight: Plane, counted: Mask) -> Plane:
    """Weights in (0, 1] by the size of a pixel's residual against the median one."""
    size = np.sqrt(weight * (remaining**2).sum(axis=2))
    typical = 1.4826 * float(np.median(size[counted])) + 1e-12
    return np.minimum(1.0, _HUBER * typical / np.maximum(size, 1e-12)).astype(np.float32)


def _normal_equations(
    columns: Sequence[Rgb], residual: Rgb, weight: Plane
) -> tuple[Float[np.ndarray, "cells unknowns unknowns"], Float[np.ndarray, "cells unknowns"]]:
    """A'WA and A'Wr of every cell of the picture, and r'Wr on the way."""
    count = len(columns)
    every = [*columns, residual]
    sums = np.zeros((_CELLS[0] * _CELLS[1], count, count + 1))
    for i in range(count):
        weighted = every[i] * weight[..., None]
        for j in range(i, count + 1):
            sums[:, i, j] = _cell_sums((weighted * every[j]).sum(axis=2))
            if j < count:
                sums[:, j, i] = sums[:, i, j]
    return sums[..., :count], sums[..., count]


def _cell_sums(plane: Plane) -> Float[np.ndarray, " cells"]:
    rows, columns = (np.linspace(0, size, cells, endpoint=False).astype(int) for size, cells in zip(plane.shape, _CELLS, strict=True))
    return np.add.reduceat(np.add.reduceat(plane.astype(np.float64), rows, axis=0), columns, axis=1).ravel()


def _solved(
    matrices: Float[np.ndarray, "cells unknowns unknowns"], sides: Float[np.ndarray, "cells unknowns"]
) -> tuple[Float[np.ndarray, " unknowns"], Float[np.ndarray, " unknowns"]]:
    """The changes and their standard errors; a change that the picture does not show stays 0 with an infinite error."""
    matrix, side = matrices.sum(axis=0), sides.sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    seen = scale > _RIDGE * scale.max()
    inverse = np.linalg.pinv(matrix / np.outer(scale, scale) + _RIDGE * np.eye(len(scale))) / np.outer(scale, scale)
    change = np.where(seen, inverse @ side, 0.0)
    gradients = sides - matrices @ change
    covariance = inverse @ (gradients.T @ gradients) @ inverse
    return change, np.where(seen, np.sqrt(np.maximum(np.diag(covariance), 0.0)), np.inf)


def _combined(columns: Sequence[Rgb], change: Float[np.ndarray, " unknowns"]) -> Rgb:
    total = np.zeros_like(columns[0])
    for column, factor in zip(columns, change, strict=True):
        total += np.float32(factor) * column
    return total
