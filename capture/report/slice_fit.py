"""Changes that would turn a prediction into the slice: exposure, focus, size of blur, place and magnification; and errors of the depth.

One linear least squares fit per slice, slice = prediction + sum of change_k * derivative_k: a Gauss-Newton step, exact for small
changes and a lower bound of large ones. Radiance is weighted as photons are noisy (variance grows with the signal) and outliers
lose weight (Huber 1964). Residuals are alike within a neighbourhood, so that standard errors come from how cells of the picture
disagree (the sandwich of Liang and Zeger 1986, with cells as clusters), not from the number of pixels.

Where the slices contradict the depth, a Gauss-Newton step of the depth of every neighbourhood over all slices together shows it: a depth
that is off by e dioptres changes the diameter of every slice by its growth times e, all in one direction. Noise, occlusion and movement do
not keep to that.
"""

from dataclasses import dataclass, field
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

NAMES = ("exposure", "focus_px", "blur_gain", "shift_x_px", "shift_y_px", "magnification", "softness_px2")
_CELLS = (6, 8)
_ROUNDS = 4
_HUBER = 1.345
_DARK = 0.02
_RIDGE = 1e-6
_SURELY = 3.0
"""Standard errors by which nothing differs by chance."""
_NEIGHBOURHOOD_PX = 6.0
_SIGMAS = 4.0
_LEAST_FILLED = 0.6

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Columns = Float32[np.ndarray, "columns height width 3"]


@dataclass(frozen=True)
class Prediction:
    """Slice as predicted, with every diameter `step_px` smaller, and larger; coc_px: its signed diameters."""

    rgb: Rgb
    less: Rgb
    more: Rgb
    coc_px: Plane
    step_px: float

    @property
    def per_px(self) -> Rgb:
        """Return how the slice changes for each pixel by which every signed diameter grows, as if its focus were moved."""
        return (self.more - self.less) / np.float32(2.0 * self.step_px)


@dataclass(frozen=True)
class Change:
    """Number with its standard error."""

    value: float
    error: float

    def exceeds(self, limit: float) -> bool:
        """Return whether it is larger than the limit, and that not by chance."""
        return abs(self.value) > limit and abs(self.value) > _SURELY * self.error


@dataclass(frozen=True)
class SliceFit:
    """Changes that turn a prediction into the slice.

    exposure: share by which the slice is brighter. focus_px: pixels to add to every signed diameter. blur_gain: share by which blur is
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
    """Return the changes, and (H, W, 3) the slice minus the prediction so changed.

    counted: (H, W) pixels to fit; where there are none, nothing is known (infinite errors).
    """
    residual = rgb - prediction.rgb
    columns = np.stack([*_derivatives(prediction), residual])
    weight = (counted / (_DARK + np.maximum(prediction.rgb.mean(axis=2), 0.0))).astype(np.float32)
    change, errors = np.zeros(len(NAMES)), np.full(len(NAMES), np.inf)
    remaining = residual
    if counted.any():
        for _ in range(_ROUNDS):
            change, errors = _solved(*normal_equations(columns, weight * _huber(remaining, weight, counted)))
            remaining = np.tensordot(np.array([*-change, 1.0], np.float32), columns, axes=1)
    return SliceFit(*(Change(float(value), float(error)) for value, error in zip(change, errors, strict=True))), remaining


@dataclass(frozen=True)
class DepthCheck:
    """Errors of the depth.

    off_px: (H, W) by how many pixels of diameter depth is wrong in the slices, 0 where they do not tell. told: (H, W) they do.
    """

    off_px: Plane
    told: Mask

    def share_beyond(self, limit_px: float) -> float:
        """Return the share of the pixels that tell whose circles of confusion are off by more."""
        return float((np.abs(self.off_px) > limit_px)[self.told].mean()) if self.told.any() else 0.0


@dataclass
class DepthEvidence:
    """Sums over slices, one slice at a time."""

    _pulls: list[Plane] = field(default_factory=list)
    _weights: list[Plane] = field(default_factory=list)
    _squares: list[Plane] = field(default_factory=list)

    def add(self, remaining: Rgb, prediction: Prediction, counted: Mask) -> None:
        """Add a slice. remaining: slice minus prediction, after what holds for the whole slice was taken out."""
        weight = (counted / (_DARK + np.maximum(prediction.rgb.mean(axis=2), 0.0)))[..., None].astype(np.float32)
        per_px = prediction.per_px
        pull = (weight * per_px * remaining).sum(axis=2)
        self._accumulate(self._pulls, pull)
        self._accumulate(self._weights, (weight * per_px**2).sum(axis=2))
        self._accumulate(self._squares, pull**2)

    def check(self) -> DepthCheck:
        if not self._pulls:
            raise ValueError("no slice was added")
        pull, weight, square = (
            cv2.GaussianBlur(each[0], (0, 0), _NEIGHBOURHOOD_PX) for each in (self._pulls, self._weights, self._squares)
        )
        off_px = -pull / np.maximum(weight, 1e-12)
        # Of the mean of n independent pulls the deviation is that of one over sqrt(n); a Gaussian window holds 4 pi s^2 of them.
        pixels = 4.0 * np.pi * _NEIGHBOURHOOD_PX**2
        error_px = np.sqrt(square / pixels) / np.maximum(weight, 1e-12)
        informed = weight > 0.05 * np.quantile(weight, 0.9)
        told = informed & (weight > 0)
        return DepthCheck(np.where(told & (np.abs(off_px) > _SIGMAS * error_px), off_px, 0.0).astype(np.float32), told)

    @staticmethod
    def _accumulate(sums: list[Plane], plane: Plane) -> None:
        if sums:
            sums[0] += plane
        else:
            sums.append(plane.astype(np.float32))


def low_frequency_gain(rgb: Rgb, all_in_focus: Rgb, counted: Mask) -> float:
    """Return the brightness of a slice relative to the all-in-focus picture: the median ratio of their light over cells of the picture.

    Needs no lens, for blur moves light about but keeps it. nan where no cell counts.
    """
    cell = (max(1, rgb.shape[0] // _CELLS[0]), max(1, rgb.shape[1] // _CELLS[1]))
    light, expected, filled = (_cell_means(plane, cell) for plane in (_light(rgb, counted), _light(all_in_focus, counted), counted))
    use = (filled > _LEAST_FILLED) & (expected > 0)
    return float(np.median(light[use] / expected[use])) if use.any() else float("nan")


def normal_equations(
    columns: Columns, weight: Plane
) -> tuple[Float[np.ndarray, "cells unknowns unknowns"], Float[np.ndarray, "cells unknowns"]]:
    """Return A'WA and A'Wr of every cell of the picture. columns: (unknowns + 1, H, W, 3), A and then r."""
    edges = [np.linspace(0, size, cells + 1).astype(int) for size, cells in zip(weight.shape, _CELLS, strict=True)]
    sums = np.stack([_products(columns[:, rows, across], weight[rows, across]) for rows in _spans(edges[0]) for across in _spans(edges[1])])
    return sums[:, :-1, :-1], sums[:, :-1, -1]


def _derivatives(prediction: Prediction) -> list[Rgb]:
    """Return what each of NAMES changes, in their order."""
    rgb, per_px = prediction.rgb, prediction.per_px
    height, width = rgb.shape[:2]
    down, right = np.gradient(rgb, axis=(0, 1))
    x, y = np.arange(width) + 0.5 - width / 2, np.arange(height) + 0.5 - height / 2
    outwards = right * x[None, :, None].astype(np.float32) + down * y[:, None, None].astype(np.float32)
    return [rgb, per_px, per_px * prediction.coc_px[..., None], -right, -down, -outwards, 0.5 * cv2.Laplacian(rgb, cv2.CV_32F)]


def _huber(remaining: Rgb, weight: Plane, counted: Mask) -> Plane:
    """Return weights in (0, 1] by the size of a pixel's residual against the median one."""
    size = np.sqrt(weight * np.einsum("hwc,hwc->hw", remaining, remaining))
    typical = 1.4826 * float(np.median(size[counted])) + 1e-12
    return np.minimum(1.0, _HUBER * typical / np.maximum(size, 1e-12)).astype(np.float32)


def _spans(edges: np.ndarray) -> list[slice]:
    return [slice(low, high) for low, high in pairwise(edges)]


def _products(columns: Columns, weight: Plane) -> Float[np.ndarray, "columns columns"]:
    """Return every weighted product of two columns, summed over a cell in double precision: one matrix product."""
    count = len(columns)
    every = columns.reshape(count, -1).astype(np.float64)
    return (every * np.repeat(weight.ravel(), 3)) @ every.T


def _solved(
    matrices: Float[np.ndarray, "cells unknowns unknowns"], sides: Float[np.ndarray, "cells unknowns"]
) -> tuple[Float[np.ndarray, " unknowns"], Float[np.ndarray, " unknowns"]]:
    """Return the changes and their standard errors; a change that the picture does not show stays 0 with an infinite error."""
    matrix, side = matrices.sum(axis=0), sides.sum(axis=0)
    scale = np.sqrt(np.maximum(np.diag(matrix), 1e-30))
    seen = scale > _RIDGE * scale.max()
    inverse = np.linalg.pinv(matrix / np.outer(scale, scale) + _RIDGE * np.eye(len(scale))) / np.outer(scale, scale)
    change = np.where(seen, inverse @ side, 0.0)
    gradients = sides - matrices @ change
    covariance = inverse @ (gradients.T @ gradients) @ inverse
    return change, np.where(seen, np.sqrt(np.maximum(np.diag(covariance), 0.0)), np.inf)


def _light(rgb: Rgb, counted: Mask) -> Float32[np.ndarray, "height width"]:
    return np.where(counted, rgb.mean(axis=2), 0.0).astype(np.float32)


def _cell_means(plane: np.ndarray, cell: tuple[int, int]) -> np.ndarray:
    rows, columns = plane.shape[0] // cell[0], plane.shape[1] // cell[1]
    cut = plane[: rows * cell[0], : columns * cell[1]].astype(np.float64)
    return cut.reshape(rows, cell[0], columns, cell[1]).mean(axis=(1, 3))
