"""Sums of points over all pixels: taps into the picture itself, points of Laplacians into one that is then integrated.

Four channels at a time, in strips that stay in a core's cache from one step to the next, in memory that is kept from call to call.
Sums are reals, or whole numbers of 32 bits. Whole numbers take half the memory of double precision, and every pixel's additions sum to 0
to the last bit, so that no error grows with the picture. Their unit is as small as the brightest light and the points allow.
"""

from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from mrbokeh.renderers.kernels.laplacian_integration import fast_width, integrate_by_pyramid, modes_to_rows, rows_to_modes, solve_modes
from mrbokeh.renderers.kernels.laplacian_tables import Points
from mrbokeh.system.resources import ZeroedMemory, cores

FOUR = 4  # LANES of the compiled loops
FAR_FIELD_PX = 8  # beyond the reach of the points, before the border on which light is 0
_BITS = 30  # and a sign; the one left over is for rounding
_LEAST_BOUND = 1e-25  # whose gain is still a number in single precision

Cells = Int32[np.ndarray, "height width"]


class Window(NamedTuple):
    """The part of the plane that light can reach: row and column of its first pixel, and its size."""

    top: int
    left: int
    height: int
    width: int

    def holds(self, other: "Window") -> bool:
        """Return whether the other lies within."""
        begins = self.top <= other.top and self.left <= other.left
        return begins and other.top + other.height <= self.top + self.height and other.left + other.width <= self.left + self.width


def window_of(cells: Cells, reach_px: int, is_integrated: bool) -> Window:
    """Return the window that points of the pixels with a cell (>= 0) reach; for Laplacians with the border on which light is 0."""
    rows, columns = (np.flatnonzero((cells >= 0).any(axis=axis)) for axis in (1, 0))
    margin = reach_px + (1 + FAR_FIELD_PX if is_integrated else 0)
    top, left = int(rows[0]) - margin, int(columns[0]) - margin
    height, width = int(rows[-1]) + margin + 1 - top, int(columns[-1]) + margin + 1 - left
    return Window(top, left, height, fast_width(width) if is_integrated else width)


class Laid(NamedTuple):
    """Points laid out for sums of a width: places in a flat array, weights, rows and apart as from `rows_of`.

    For sums in reals weights (N,) are in their precision; for whole numbers (N + 1,) the sums of the weights before each point of a
    cell, which are 0 before the first one and after the last.
    """

    offsets: Int32[np.ndarray, " points"]
    weights: Float[np.ndarray, " weights"]
    rows: Int32[np.ndarray, "cells rows"]
    apart: Bool[np.ndarray, " cells"]
    reach_px: int

    @classmethod
    def out(cls, points: Points, width: int, precision: type) -> "Laid":
        """Lay points out. precision: of the sums, numpy.int32 for whole numbers, whose points must be of Laplacians (weights sum to 0)."""
        from mrbokeh.renderers.spreadlets._splat_numba import rows_of

        offsets = (FOUR * (points.xy[:, 1] * width + points.xy[:, 0])).astype(np.int32)
        weights = _sums_before(points) if precision is np.int32 else points.weights.astype(precision)
        rows, apart = rows_of(points.xy, points.starts, points.reach_px)
        return cls(offsets=offsets, weights=weights, rows=rows, apart=apart, reach_px=points.reach_px)


def gains_for(largest: Float32[np.ndarray, " channels"], points: Points) -> Float32[np.ndarray, " lanes"]:
    """Return powers of two that make light, at most `largest` in each channel, as large as whole numbers can hold its sums."""
    from mrbokeh.renderers.spreadlets._splat_numba import largest_sum

    bound = np.zeros(FOUR)
    bound[: len(largest)] = largest
    bound *= largest_sum(points.xy, points.weights, points.reach_px)
    return np.ldexp(1.0, _BITS - np.frexp(np.maximum(bound, _LEAST_BOUND))[1]).astype(np.float32)


def _sums_before(points: Points) -> Float32[np.ndarray, " weights"]:
    sums = np.cumsum(points.weights) - points.weights
    sums -= np.repeat(sums[points.starts[:-1]], np.diff(points.starts))
    return np.append(sums, 0.0).astype(np.float32)


_LEAST_ROWS, _STRIPS_PER_CORE = 64, 2  # pixels beside two strips are looked at by both

Sums = Float[np.ndarray, "rows columns channels"]
Values = Float32[np.ndarray, "height width channels"]


def add_light(
    out: Values,
    values: Values,
    cells: Cells,
    points: Points,
    integration: str | None,
    threads: int,
    memory: ZeroedMemory | None = None,
    largest: Float32[np.ndarray, " channels"] | None = None,
    taps: tuple[Cells, Points] | None = None,
) -> None:
    """Add the light of all pixels that have a cell (>= 0) to out; integration None: the points are taps of kernels.

    Sums go on beyond the picture as far as points reach: a Laplacian that is cut off is that of another picture. memory: kept
    from call to call; to get it anew takes as long as to integrate. Points of Laplacians are
    summed in double precision; if it is known that no light of a channel is larger than `largest`, without sign, in whole numbers,
    which become single precision. taps: cells and points of other pixels to splat as they are.
    """
    window, memory = window_of(cells, points.reach_px, integration is not None), memory or ZeroedMemory()
    largest = None if largest is None or not np.isfinite(largest).all() else largest
    if taps is not None and (largest is None or not window.holds(window_of(taps[0], taps[1].reach_px, False))):
        add_light(out, values, *taps, None, threads, memory)
        taps = None
    with ThreadPoolExecutor(threads or cores()) as pool:
        for first, part in _fours(values):
            gains = None if largest is None else gains_for(largest[first : first + FOUR], points)
            splatting = _Splatting.of(part, cells, points, window, np.float32 if integration is None else np.float64, gains)
            sharper = None if taps is None else _Splatting.of(part, *taps, window, np.float32)
            _add_four(out[..., first : first + FOUR], splatting, sharper, integration, pool, memory)


def _add_four(
    out: Float32[np.ndarray, "height width some"],
    splatting: "_Splatting",
    taps: "_Splatting | None",
    integration: str | None,
    pool: ThreadPoolExecutor,
    memory: ZeroedMemory,
) -> None:
    """Splat, integrate, splat taps onto the result, and add to out."""
    from mrbokeh.renderers.spreadlets._splat_numba import add_and_clear

    window = splatting.window
    elements = window.height * window.width * FOUR
    held = memory.take(elements, splatting.laid.weights.dtype.type)
    sums = held[:elements].reshape(window.height, window.width, FOUR)
    seen = range(max(0, -window.top), min(window.height, len(out) - window.top))

    def fill(first: int, end: int) -> None:
        splatting.fill(sums, first, end)
        if integration == "exact":
            rows_to_modes(sums[first:end])

    def empty(first: int, end: int) -> None:
        top, bottom = max(first, seen.start), min(end, seen.stop)
        if integration == "exact" and top < bottom:
            modes_to_rows(sums[top:bottom])
        if taps is not None and top < bottom:
            taps.fill(sums, top, bottom)
        add_and_clear(out, sums, window[:2], first, end)

    strips = _strips(window.height, splatting.laid.reach_px)
    list(pool.map(fill, *zip(*strips, strict=True)))
    if integration == "exact":
        solve_modes(sums, pool)
    elif integration == "pyramid":
        sums[:] = integrate_by_pyramid(sums)
    list(pool.map(empty, *zip(*strips, strict=True)))
    memory.give_back(held)


class _Splatting(NamedTuple):
    """Light and points to splat, and where the sums lie in the picture. gains: of light in whole numbers, None for sums in reals."""

    values: Float32[np.ndarray, "height width lanes"]
    cells: Cells
    laid: Laid
    window: Window
    gains: Float32[np.ndarray, " lanes"] | None

    @classmethod
    def of(
        cls,
        values: Float32[np.ndarray, "height width lanes"],
        cells: Cells,
        points: Points,
        window: Window,
        precision: type,
        gains: Float32[np.ndarray, " lanes"] | None = None,
    ) -> "_Splatting":
        """Lay points out for splatting. precision: of the sums without gains."""
        return cls(
            values=values,
            cells=cells,
            laid=Laid.out(points, window.width, precision if gains is None else np.int32),
            window=window,
            gains=gains,
        )

    def fill(self, sums: Sums, first: int, end: int) -> None:
        """Add what falls into rows first:end, which are zeros if there are gains."""
        from mrbokeh.renderers.spreadlets._splat_numba import splat_strip, to_reals

        into = sums if self.gains is None else sums.view(np.int32)
        gains = np.ones(FOUR, np.float32) if self.gains is None else self.gains
        splat_strip(into, self.values, self.cells, self.laid[:4], gains, self.window[:2], first, end)
        if self.gains is not None:
            to_reals(into[first:end], sums[first:end], gains)


def splat(sums: Sums, values: Values, cells: Cells, points: Points, origin: tuple[int, int], each: Callable[..., Iterable] = map) -> None:
    """Add every pixel's points to sums, whose first pixel lies at row and column `origin`. Same bits however `each` divides the work."""
    for first, part in _fours(values):
        into = np.zeros((*sums.shape[:2], FOUR), sums.dtype)
        fill = partial(_Splatting.of(part, cells, points, Window(*origin, *into.shape[:2]), sums.dtype.type).fill, into)
        list(each(fill, *zip(*_strips(len(into), points.reach_px), strict=True)))
        sums[..., first : first + FOUR] += into[..., : sums.shape[2] - first]


def _fours(values: Values) -> Iterator[tuple[int, Values]]:
    """Yield groups of four channels, the last filled up with zeros, each in memory of its own, and the first channel of each."""
    channels = values.shape[2]
    if channels == FOUR:
        yield 0, np.ascontiguousarray(values)
        return
    for first in range(0, channels, FOUR):
        part = values[..., first : first + FOUR]
        yield first, np.ascontiguousarray(np.pad(part, ((0, 0), (0, 0), (0, FOUR - part.shape[2]))))


def _strips(height: int, reach_px: int) -> list[tuple[int, int]]:
    """Return first and end row of pieces for the cores."""
    rows = max(_LEAST_ROWS, reach_px, -(-height // (_STRIPS_PER_CORE * cores())))
    return [(first, min(first + rows, height)) for first in range(0, height, rows)]
