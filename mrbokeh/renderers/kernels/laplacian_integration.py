"""Integration: a picture from its Laplacian (Leimkuehler et al. 2018, Sections 4 and 6.3).

The Laplacian is the isotropic 3x3 one, ((1, 4, 1), (4, -20, 4), (1, 4, 1)) / 6. Its error term is the squared Laplacian / 12, so that
polynomials up to degree 3 and harmonic ones up to degree 7 have their true Laplacian; `mrbokeh.renderers.kernels.spreadlets` counts on
both. Pictures are zero on a border and beyond, which makes the answer unique.

`integrate` inverts just this operator: a sine transform along rows decouples the columns, and every column is a
tridiagonal system with two sweeps. Nothing is approximated; a picture that is zero within one pixel of the border comes
back to rounding. `integrate_by_pyramid` is the convolution pyramid of Farbman et al. 2011, kept for comparison.

Measured (tests/bench/bench_laplacian_spreadlets.py, 1024 x 1024, 4 channels): the exact way is off by 2e-11 at most in double and
1e-5 in single precision, the pyramid by 3 % on average and 10 % at most for discs and textures (as Moroto found) and by 10 and
16 % where an area of 800 px is lit, a bias that scales the whole picture. They take the same time in single precision (96 and
106 ms); in double the exact way takes half the pyramid's. So it is the default.
"""

from collections.abc import Callable
from concurrent.futures import Executor
from functools import lru_cache
from itertools import pairwise

import numpy as np
from jaxtyping import Float, Float64

from mrbokeh.system.errors import InputError
from mrbokeh.system.resources import workers

STENCIL = np.array([[1.0, 4.0, 1.0], [4.0, -20.0, 4.0], [1.0, 4.0, 1.0]]) / 6.0
_CHUNK_MODES = 128  # columns that a thread solves at a time

_PYRAMID_REDUCE = np.array([0.15, 0.5, 0.7, 0.5, 0.15])
_PYRAMID_LEVEL = np.array([0.175, 0.547, 0.175])
"""Filters h1 (= h2) and g that Farbman et al. 2011 publish for gradient integration; each is used along rows and columns."""
_PYRAMID_BORDER_PX = 5
_PYRAMID_INSIDE = np.s_[_PYRAMID_BORDER_PX:-_PYRAMID_BORDER_PX, _PYRAMID_BORDER_PX:-_PYRAMID_BORDER_PX]

Channels = Float[np.ndarray, "height width channels"]


def laplacian(image: Float[np.ndarray, "height width *channels"]) -> Float64[np.ndarray, "height_out width_out *channels"]:
    """Return the 3x3 Laplacian of a picture that is zero outside, one pixel larger on each side."""
    padded = np.pad(image.astype(np.float64), ((2, 2), (2, 2), *((0, 0),) * (image.ndim - 2)))
    height, width = image.shape[0] + 2, image.shape[1] + 2
    return sum(STENCIL[j, i] * padded[j : j + height, i : i + width] for j in range(3) for i in range(3))


def fast_width(width: int) -> int:
    """Return the next width at which the sine transform is quick."""
    from scipy.fft import next_fast_len

    return next_fast_len(width, real=True)


def integrate(source: Channels, threads: int = 0) -> Channels:
    """Return the picture (H, W, C) whose 3x3 Laplacian is this, zero beyond the border; in the precision of the source.

    To the left and right the picture is continued antisymmetrically about the border, above and below by zeros. Widths
    as from `fast_width` are quickest. threads: 0 takes all cores; the result does not depend on it.
    """
    from scipy.fft import dst, idst

    _check(source)
    with workers(source.shape[0] * source.shape[1], threads) as pool:
        count = _threads_of(pool)
        modes = dst(source, type=2, axis=1, workers=count)
        solve_modes(modes, pool)
        return idst(modes, type=2, axis=1, workers=count, overwrite_x=True)


def rows_to_modes(rows: Channels) -> None:
    """The first step of `integrate`, in place, for some rows of the source (contiguous): they become sine modes."""
    from scipy.fft import dst

    _in_place(dst, rows)


def solve_modes(modes: Channels, pool: Executor) -> None:
    """The second step of `integrate`, in place, for the modes of all rows."""
    from mrbokeh.renderers.kernels._laplacian_numba import solve_columns

    height, width, _ = modes.shape
    beside, pivot = _system(height, width)
    chunks = [*range(0, width, _CHUNK_MODES), width]
    list(pool.map(lambda chunk: solve_columns(modes, pivot, -1.0 / beside, *chunk), pairwise(chunks)))


def modes_to_rows(modes: Channels) -> None:
    """The last step of `integrate`, in place, for the modes of some rows (contiguous): they become rows of the picture."""
    from scipy.fft import idst

    _in_place(idst, modes)


def _in_place(transform: Callable[..., Channels], rows: Channels) -> None:
    found = transform(rows, type=2, axis=1, overwrite_x=True)
    if not np.may_share_memory(found, rows):
        rows[:] = found


@lru_cache(maxsize=4)
def _system(height: int, width: int) -> tuple[Float64[np.ndarray, " modes"], Float64[np.ndarray, "height modes"]]:
    """Return for every sine mode the weight of the neighbours in a column, and the reciprocal pivots of its elimination."""
    from mrbokeh.renderers.kernels._laplacian_numba import pivots

    cosine = np.cos(np.pi * np.arange(1, width + 1) / width)
    beside = (4.0 + 2.0 * cosine) / 6.0
    return beside, pivots((20.0 - 8.0 * cosine) / 6.0 / beside, height)


def integrate_by_pyramid(source: Channels) -> Channels:
    """Return nearly the same as `integrate` by a convolution pyramid (Farbman et al. 2011): a few small filters per level, no transform."""
    import cv2

    _check(source)

    def filtered(values: Channels, taps: Float64[np.ndarray, " taps"]) -> Channels:
        return cv2.sepFilter2D(values, -1, taps, taps, borderType=cv2.BORDER_CONSTANT).reshape(values.shape)

    levels = [_bordered(source)]
    for _ in range(int(np.ceil(np.log2(max(source.shape[:2])))) - 1):
        levels.append(_bordered(filtered(levels[-1], _PYRAMID_REDUCE)[::2, ::2]))
    result = filtered(levels[-1], _PYRAMID_LEVEL)
    for level in reversed(levels[:-1]):
        spaced = np.zeros_like(level)
        spaced[::2, ::2] = result[_PYRAMID_INSIDE]
        result = filtered(spaced, _PYRAMID_REDUCE) + filtered(level, _PYRAMID_LEVEL)
    return np.ascontiguousarray(-result[_PYRAMID_INSIDE])


def _bordered(values: Channels) -> Float[np.ndarray, "height_out width_out channels"]:
    """Pad with zeros all around, at every level, so that nothing is reflected."""
    border = (_PYRAMID_BORDER_PX, _PYRAMID_BORDER_PX)
    return np.pad(values, (border, border, (0, 0)))


def _threads_of(pool: Executor) -> int:
    return getattr(pool, "_max_workers", 1)


def _check(source: np.ndarray) -> None:
    if min(source.shape[:2]) < 3:
        raise InputError(f"a Laplacian to integrate needs at least 3 x 3 pixels, got {source.shape[1]} x {source.shape[0]}")
