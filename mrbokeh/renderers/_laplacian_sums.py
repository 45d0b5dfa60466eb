"""Points of all pixels summed up: taps into the picture itself, points of Laplacians into one that is then integrated.

Four channels at a time, in strips that stay in a core's cache from one step to the next, in memory that is kept from call to call.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from mrbokeh.laplacian_integration import fast_width, integrate_by_pyramid, modes_to_rows, rows_to_modes, solve_modes
from mrbokeh.renderers._laplacian_tables import Points
from mrbokeh.workers import cores
from mrbokeh.zeroed_memory import ZeroedMemory

_LEAST_ROWS, _STRIPS_PER_CORE = 64, 2  # pixels beside two strips are looked at by both
_MOST_KEPT_BYTES = 1 << 27
_EVEN = 64.0  # of the mean: with errors of 2e-6 of what is bright, 1e-4 of the mean at most
_FOUR = 4  # LANES of the compiled loops
FAR_FIELD_PX = 8  # beyond the reach of the points, before the border on which light is 0

Sums = Float[np.ndarray, "rows columns channels"]
Values = Float32[np.ndarray, "height width channels"]
Cells = Int32[np.ndarray, "height width"]


class Window(NamedTuple):
    """The part of the plane that light can reach: row and column of its first pixel, and its size."""

    top: int
    left: int
    height: int
    width: int


def window_of(cells: Cells, reach_px: int, is_integrated: bool) -> Window:
    """What points of the pixels that have a cell (>= 0) reach, and for Laplacians the border on which light is 0."""
    rows, columns = (np.flatnonzero((cells >= 0).any(axis=axis)) for axis in (1, 0))
    margin = reach_px + (1 + FAR_FIELD_PX if is_integrated else 0)
    top, left = int(rows[0]) - margin, int(columns[0]) - margin
    height, width = int(rows[-1]) + margin + 1 - top, int(columns[-1]) + margin + 1 - left
    return Window(top, left, height, fast_width(width) if is_integrated else width)


def add_light(
    out: Values,
    values: Values,
    cells: Cells,
    points: Points,
    integration: str | None,
    threads: int,
    memory: ZeroedMemory | None = None,
    is_precise: bool = True,
) -> None:
    """Add the light of all pixels that have a cell (>= 0) to out; integration None: the points are taps of kernels.

    What points reach beyond the picture is summed, too: a Laplacian that is cut off is that of another picture. memory: kept
    from call to call where there is not too much of it; to get it anew takes as long as to integrate. is_precise: integrate in double
    precision always, not only where light `is_even`; sums of points of Laplacians are in double precision anyway.
    """
    window, memory = window_of(cells, points.reach_px, integration is not None), memory or ZeroedMemory()
    laid = _Laid.out(points, window.width, np.float32 if integration is None else np.float64)
    in_single = integration == "exact" and not is_precise and is_even(values)
    with ThreadPoolExecutor(threads or cores()) as pool:
        for first, part in _fours(values):
            _add_four(out[..., first : first + _FOUR], _Splatting(part, cells, laid, window), integration, in_single, pool, memory)


def is_even(values: Values) -> bool:
    """Whether no light is so much brighter than the mean that integrating in single precision would leave errors in what is dim."""
    return bool(max(values.max(), -values.min()) <= _EVEN * abs(values.mean()))


def _add_four(
    out: Float32[np.ndarray, "height width some"],
    splatting: "_Splatting",
    integration: str | None,
    in_single: bool,
    pool: ThreadPoolExecutor,
    memory: ZeroedMemory,
) -> None:
    """Splat, integrate (in single precision or that of the sums) and add to out."""
    from mrbokeh.renderers._laplacian_splat_numba import add_and_clear, move

    window = splatting.window
    elements, size = window.height * window.width * _FOUR, (window.height, window.width, _FOUR)
    precisions = [splatting.laid.weights.dtype.type, *([np.float32] if in_single else [])]
    held = [memory.take(elements, precision) for precision in precisions]
    sums, modes = (each[:elements].reshape(size) for each in (held[0], held[-1]))
    seen = range(max(0, -window.top), min(window.height, len(out) - window.top))

    def fill(first: int, end: int) -> None:
        splatting.fill(sums, first, end)
        if in_single:
            move(sums[first:end].reshape(-1), modes[first:end].reshape(-1))
        if integration == "exact":
            rows_to_modes(modes[first:end])

    def empty(first: int, end: int) -> None:
        top, bottom = max(first, seen.start), min(end, seen.stop)
        if integration == "exact" and top < bottom:
            modes_to_rows(modes[top:bottom])
        add_and_clear(out, modes, window[:2], first, end)

    strips = _strips(window.height, splatting.laid.reach_px)
    list(pool.map(fill, *zip(*strips, strict=True)))
    if integration == "exact":
        solve_modes(modes, pool)
    elif integration == "pyramid":
        modes[:] = integrate_by_pyramid(modes)
    list(pool.map(empty, *zip(*strips, strict=True)))
    for each in held:
        if each.nbytes <= _MOST_KEPT_BYTES:
            memory.give_back(each)


class _Laid(NamedTuple):
    """Points laid out for sums of a width: places in a flat array, weights in its precision, rows and apart as from `rows_of`."""

    offsets: Int32[np.ndarray, " points"]
    weights: Float[np.ndarray, " points"]
    rows: Int32[np.ndarray, "cells rows"]
    apart: Bool[np.ndarray, " cells"]
    reach_px: int

    @classmethod
    def out(cls, points: Points, width: int, precision: type) -> "_Laid":
        from mrbokeh.renderers._laplacian_splat_numba import rows_of

        offsets = (_FOUR * (points.xy[:, 1] * width + points.xy[:, 0])).astype(np.int32)
        return cls(offsets, points.weights.astype(precision), *rows_of(points.xy, points.starts, points.reach_px), points.reach_px)


class _Splatting(NamedTuple):
    """What is splatted, and where the sums lie in the picture."""

    values: Float32[np.ndarray, "height width lanes"]
    cells: Cells
    laid: _Laid
    window: Window

    def fill(self, sums: Sums, first: int, end: int) -> None:
        """Add what falls into rows first:end."""
        from mrbokeh.renderers._laplacian_splat_numba import splat_strip

        splat_strip(sums, self.values, self.cells, *self.laid[:4], self.window[:2], first, end)


def splat(sums: Sums, values: Values, cells: Cells, points: Points, origin: tuple[int, int], each: Callable[..., Iterable] = map) -> None:
    """Add every pixel's points to sums, whose first pixel lies at row and column `origin`. Same bits however `each` divides the work."""
    for first, part in _fours(values):
        into = np.zeros((*sums.shape[:2], _FOUR), sums.dtype)
        laid = _Laid.out(points, into.shape[1], sums.dtype.type)
        fill = partial(_Splatting(part, cells, laid, Window(*origin, *into.shape[:2])).fill, into)
        list(each(fill, *zip(*_strips(len(into), points.reach_px), strict=True)))
        sums[..., first : first + _FOUR] += into[..., : sums.shape[2] - first]


def splat_plainly(sums: Sums, values: Values, cells: Cells, points: Points, origin: tuple[int, int]) -> None:
    """The slow and obvious twin of `splat`."""
    for y, x in np.argwhere(cells >= 0):
        part = slice(points.starts[cells[y, x]], points.starts[cells[y, x] + 1])
        for (right, down), weight in zip(points.xy[part], points.weights[part], strict=True):
            sums[y + down - origin[0], x + right - origin[1]] += weight * values[y, x]


def _fours(values: Values) -> Iterator[tuple[int, Values]]:
    """Groups of four channels, the last filled up with zeros, each in memory of its own, and the first channel of each."""
    channels = values.shape[2]
    if channels == _FOUR:
        yield 0, np.ascontiguousarray(values)
        return
    for first in range(0, channels, _FOUR):
        part = values[..., first : first + _FOUR]
        yield first, np.ascontiguousarray(np.pad(part, ((0, 0), (0, 0), (0, _FOUR - part.shape[2]))))


def _strips(height: int, reach_px: int) -> list[tuple[int, int]]:
    """First and end row of pieces for the cores."""
    rows = max(_LEAST_ROWS, reach_px, -(-height // (_STRIPS_PER_CORE * cores())))
    return [(first, min(first + rows, height)) for first in range(0, height, rows)]
