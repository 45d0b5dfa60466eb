"""Low-rank kernels: a PSF as a sum of few separable ones (McGraw, Fast Bokeh Effects Using Low-Rank Linear Filters).

The singular values say how much of a kernel the first r terms leave out (McGraw, Eq. 2 to 4). Eq. 3 as printed lacks a
square root: here both norms of the relative error are Frobenius norms, sqrt(s_{r+1}^2 + ... + s_m^2) / sqrt(s_1^2 + ... + s_m^2).
Kernels are tabulated at fixed diameters (levels), and every pixel shares its light between the two levels next to its own.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Float64, Int, Int16

from mrbokeh.optics.aperture import Aperture
from mrbokeh.system.errors import InputError

_EXACT = 1e-12  # an error below this is rounding
_SYMMETRY = 1e-9  # largest difference to the transpose, as a share of the largest value, of a kernel that counts as symmetric
_CORRECTION_SHARE = 0.3  # of the error; a correction of the centroid larger than that costs more (5 %) than it gives


@dataclass(frozen=True)
class LowRankKernel:
    """A square kernel as the sum over terms of weight * outer(column, row).

    weights: (rank,) the largest singular values, slightly corrected (see `decompose`), or signed eigenvalues.
    columns: (rank, K) unit vectors down the picture. rows: (rank, K) unit vectors across it, or None where the kernel
    is symmetric as a matrix: then the columns serve for both (the Schur form k = Q L Q^T, half the storage).
    relative_error: what is missing of the kernel, norm over norm.
    """

    weights: Float64[np.ndarray, " rank"]
    columns: Float64[np.ndarray, "rank size"]
    rows: Float64[np.ndarray, "rank size"] | None
    relative_error: float

    @property
    def rank(self) -> int:
        return len(self.weights)

    @property
    def radius_px(self) -> int:
        return self.columns.shape[1] // 2

    @property
    def is_symmetric(self) -> bool:
        return self.rows is None

    @property
    def scaled_columns(self) -> Float64[np.ndarray, "rank size"]:
        """Columns u' = sqrt(|s|) u of McGraw's Section 3."""
        return np.sqrt(np.abs(self.weights))[:, None] * self.columns

    @property
    def scaled_rows(self) -> Float64[np.ndarray, "rank size"]:
        """Rows v' = sqrt(|s|) v; they carry the sign of a negative weight."""
        return (np.sign(self.weights) * np.sqrt(np.abs(self.weights)))[:, None] * (self.columns if self.rows is None else self.rows)

    def dense(self) -> Float64[np.ndarray, "size size"]:
        """Return the sum of all terms."""
        return self.scaled_columns.T @ self.scaled_rows


def relative_errors(kernel: Float[np.ndarray, "rows columns"]) -> Float64[np.ndarray, " size"]:
    """Return the relative errors of the best approximations of rank 1, 2, ... size of a kernel, norm over norm; they fall from below 1 to
    0.
    """
    return _errors(np.linalg.svd(_square(kernel), compute_uv=False))


def aperture_errors(aperture: Aperture, diameter_px: float) -> Float64[np.ndarray, " size"]:
    """Return `relative_errors` of the PSF at this diameter: one curve of McGraw's Fig. 3."""
    return relative_errors(aperture.rasterize(diameter_px).kernel)


def decompose(
    kernel: Float[np.ndarray, "rows columns"], relative_error: float = 0.0, max_rank: int | None = None, min_rank: int = 1
) -> LowRankKernel:
    """Return the first terms of a kernel, as few as meet `relative_error`, at least `min_rank` (if it has as many), at most `max_rank`.

    Cutting the sum short loses energy. The weights are therefore changed by the least amount (in the sense of squares,
    which is the Frobenius norm of the change, as the terms are orthonormal) that gives the sum of the terms the sum of
    the kernel and its centroid; the centroid is let go where keeping it would raise the error by more than 5 % (few
    terms of a kernel without an upright axis of symmetry). The relative error stated is that of the corrected kernel.
    """
    kernel = _square(kernel)
    weights, columns, rows = _terms(kernel)
    rank = _rank(_errors(np.abs(weights)), relative_error, max_rank, min_rank)
    weights, columns, rows = weights[:rank], columns[:rank], None if rows is None else rows[:rank]
    weights = _balanced(weights, columns, columns if rows is None else rows, kernel)
    short = LowRankKernel(weights, columns, rows, 0.0)
    missing = float(np.linalg.norm(kernel - short.dense()) / np.linalg.norm(kernel))
    return LowRankKernel(weights, columns, rows, missing)


def _square(kernel: Float[np.ndarray, "..."]) -> Float64[np.ndarray, "size size"]:
    if kernel.ndim != 2 or kernel.shape[0] != kernel.shape[1] or not np.isfinite(kernel).all() or not kernel.any():
        raise InputError(f"expected a square, finite kernel that is not all 0, got shape {kernel.shape}")
    return kernel.astype(np.float64)


def _terms(kernel: Float64[np.ndarray, "size size"]) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return weights, largest first, columns and rows; no rows where the kernel is its own transpose."""
    if np.abs(kernel - kernel.T).max() <= _SYMMETRY * np.abs(kernel).max():
        values, vectors = np.linalg.eigh(0.5 * (kernel + kernel.T))
        order = np.argsort(-np.abs(values), kind="stable")
        return values[order], vectors.T[order], None
    columns, values, rows = np.linalg.svd(kernel)
    return values, columns.T, rows


def _errors(singular_values: Float64[np.ndarray, " size"]) -> Float64[np.ndarray, " size"]:
    left_out = np.append(np.cumsum(singular_values[::-1] ** 2)[::-1], 0.0)
    return np.sqrt(left_out[1:] / left_out[0])


def _rank(errors: Float64[np.ndarray, " size"], relative_error: float, max_rank: int | None, min_rank: int) -> int:
    enough, full = (1 + int(np.argmax(errors <= target)) for target in (max(relative_error, _EXACT), _EXACT))
    return min(max(enough, min(min_rank, full)), len(errors) if max_rank is None else max(1, max_rank))


def _balanced(weights: np.ndarray, columns: np.ndarray, rows: np.ndarray, kernel: Float64[np.ndarray, "size size"]) -> np.ndarray:
    """Return the weights nearest to the given ones whose terms have the sum (and the centroid) of the kernel."""
    away = np.linspace(-1.0, 1.0, kernel.shape[0]) if kernel.shape[0] > 1 else np.zeros(1)
    ones = np.ones_like(away)
    moments = ((ones, ones), (ones, away), (away, ones))
    conditions = np.array([(columns @ down) * (rows @ across) for down, across in moments])
    missing = np.array([down @ kernel @ across for down, across in moments]) - conditions @ weights
    left_out = np.sqrt(max(0.0, float(np.sum(kernel**2) - np.sum(weights**2))))
    for count in (3, 1):
        change = np.linalg.lstsq(conditions[:count], missing[:count], rcond=1e-9)[0]
        if np.linalg.norm(change) <= _CORRECTION_SHARE * left_out and np.allclose(conditions[:count] @ change, missing[:count], atol=1e-12):
            break
    return weights + change


_BEGINS_PX = np.array([0.0, 4.0, 10.0, 20.0])
_LEVELS_PER_PX = np.array([8.0, 4.0, 2.0, 1.0])
"""Levels lie 1/8 px of diameter apart up to 4 px, 1/4 px up to 10 px, 1/2 px up to 20 px and 1 px from there."""
_ZEROS_BEFORE, _ZEROS_BEHIND = 3, 6  # around the taps of a column, see _low_rank_filter_numba._down


@dataclass(frozen=True)
class Levels:
    """Levels of a picture's pixels: each takes 1 - upper of its level's kernel and upper of the next one's.

    diameters_px: one per level in use, from the lowest; nan where no pixel needs it.
    level: (H, W) index into diameters_px, negative for pixels that take no part. upper: (H, W) in [0, 1).
    """

    diameters_px: tuple[float, ...]
    level: Int16[np.ndarray, "height width"]
    upper: Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class Taps:
    """Kernels of all levels in arrays of one size, in the order in which compiled code reads them; see scatter_piece."""

    columns: Float32[np.ndarray, "levels terms padded"]
    rows: Float32[np.ndarray, "levels terms size"]
    ranks: Int[np.ndarray, " levels"]
    radii_px: Int[np.ndarray, " levels"]


def levels_of(diameters_px: Float32[np.ndarray, "height width"], exact: Float32[np.ndarray, "height width"]) -> Levels:
    """Sort the pixels with a diameter above 0 that are not wholly spread exactly (`exact`, a share) into levels.

    The steps are fixed, so that a pixel's kernel depends on nothing but its own diameter; only where all of them have the
    same diameter it is taken as it is, as a level of its own.
    """
    from mrbokeh.renderers.kernels._low_rank_numba import NOT_A_LEVEL, sort_into_levels

    level, upper = np.empty(diameters_px.shape, np.int16), np.empty(diameters_px.shape, np.float32)
    largest_px = float(diameters_px.max())
    if (diameters_px == np.float32(largest_px)).sum() == np.count_nonzero(diameters_px):
        level[:] = np.where((diameters_px > 0) & (exact < 1.0), 0, NOT_A_LEVEL)
        upper[:] = 0.0
        return Levels((largest_px,), level, upper)
    steps_px = _grid_px(largest_px)
    used = np.zeros(len(steps_px), bool)
    sort_into_levels(level, upper, used, diameters_px, exact, _BEGINS_PX, _LEVELS_PER_PX)
    lowest, end = int(np.argmax(used)), len(used) - int(np.argmax(used[::-1]))
    level -= np.where(level >= 0, np.int16(lowest), np.int16(0))
    return Levels(tuple(np.where(used, steps_px, np.nan)[lowest:end].tolist()), level, upper)


def _grid_px(largest_px: float) -> np.ndarray:
    """Return the diameters of the levels up to the first beyond the largest."""
    ends_px = [*_BEGINS_PX[1:], max(_BEGINS_PX[-1], np.ceil(largest_px)) + 2.0]
    return np.concatenate([np.arange(begin, end, 1.0 / per) for begin, end, per in zip(_BEGINS_PX, ends_px, _LEVELS_PER_PX, strict=True)])


def taps_of(levels: Levels, kernel_at: Callable[[float], LowRankKernel], mirrored: bool) -> Taps:
    """Return the kernels of all levels as taps; mirrored: for pixels in front of the focus."""
    kernels = [None if np.isnan(diameter_px) else kernel_at(diameter_px) for diameter_px in levels.diameters_px]
    known = [kernel for kernel in kernels if kernel is not None]
    terms, size = max(kernel.rank for kernel in known), 2 * max(kernel.radius_px for kernel in known) + 1
    columns = np.zeros((len(kernels), terms, _ZEROS_BEFORE + size + _ZEROS_BEHIND), np.float32)
    rows = np.zeros((len(kernels), terms, size), np.float32)
    order = slice(None) if mirrored else slice(None, None, -1)  # seen from the result, a kernel is met from its far end
    for i, kernel in enumerate(kernels):
        if kernel is not None:
            count = 2 * kernel.radius_px + 1
            columns[i, : kernel.rank, _ZEROS_BEFORE : _ZEROS_BEFORE + count] = kernel.scaled_columns[:, order]
            rows[i, : kernel.rank, :count] = kernel.scaled_rows[:, order]
    return Taps(columns, rows, _each(kernels, lambda kernel: kernel.rank), _each(kernels, lambda kernel: kernel.radius_px))


def _each(kernels: Sequence[LowRankKernel | None], of: Callable[[LowRankKernel], int]) -> Int[np.ndarray, " levels"]:
    return np.array([0 if kernel is None else of(kernel) for kernel in kernels], np.int64)
