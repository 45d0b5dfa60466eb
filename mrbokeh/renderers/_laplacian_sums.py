"""Points of all pixels summed up: taps into the picture itself, points of Laplacians into one that is then integrated."""

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Float32, Int32

from mrbokeh.laplacian_integration import fast_width, integrate, integrate_by_pyramid
from mrbokeh.renderers._laplacian_tables import Points
from mrbokeh.workers import cores

_LEAST_ROWS, _STRIPS_PER_CORE = 64, 2  # pixels beside two strips are looked at by both
FAR_FIELD_PX = 8  # beyond the reach of the points, before the border on which light is 0


class Window(NamedTuple):
    """The part of the plane that light can reach: row and column of its first pixel, and its size."""

    top: int
    left: int
    height: int
    width: int


def window_of(cells: Int32[np.ndarray, "height width"], reach_px: int, is_integrated: bool) -> Window:
    """What points of the pixels that have a cell (>= 0) reach, and for Laplacians the border on which light is 0."""
    rows, columns = (np.flatnonzero((cells >= 0).any(axis=axis)) for axis in (1, 0))
    margin = reach_px + (1 + FAR_FIELD_PX if is_integrated else 0)
    top, left = int(rows[0]) - margin, int(columns[0]) - margin
    height, width = int(rows[-1]) + margin + 1 - top, int(columns[-1]) + margin + 1 - left
    return Window(top, left, height, fast_width(width) if is_integrated else width)


def add_light(
    out: Float32[np.ndarray, "height width channels"],
    values: Float32[np.ndarray, "height width channels"],
    cells: Int32[np.ndarray, "height width"],
    points: Points,
    integration: str | None,
    threads: int,
) -> None:
    """Add the light of all pixels that have a cell (>= 0) to out; integration None: the points are taps of kernels.

    What points reach beyond the picture is summed, too: a Laplacian that is cut off is that of another picture.
    """
    top, left, height, width = window_of(cells, points.reach_px, integration is not None)
    sums = np.zeros((height, width, values.shape[2]), np.float32 if integration is None else np.float64)
    with ThreadPoolExecutor(threads or cores()) as pool:
        splat(sums, values, cells, points, (top, left), pool.map)
    if integration is not None:
        sums = integrate(sums, threads) if integration == "exact" else integrate_by_pyramid(sums)
    y0, x0, y1, x1 = max(0, top), max(0, left), min(out.shape[0], top + height), min(out.shape[1], left + width)
    out[y0:y1, x0:x1] += sums[y0 - top : y1 - top, x0 - left : x1 - left]


def splat(
    sums: Float[np.ndarray, "rows columns channels"],
    values: Float32[np.ndarray, "height width channels"],
    cells: Int32[np.ndarray, "height width"],
    points: Points,
    origin: tuple[int, int],
    each: Callable[[Callable, Iterable], Iterable] = map,
) -> None:
    """Add every pixel's points to sums, whose first pixel lies at row and column `origin`. Same bits however `each` divides the work."""
    from mrbokeh.renderers._laplacian_splat_numba import LANES, splat_strip

    channels = values.shape[2]
    missing = -channels % LANES
    padded = np.pad(values, ((0, 0), (0, 0), (0, missing))) if missing else values
    into = np.zeros((*sums.shape[:2], channels + missing), sums.dtype) if missing else sums
    flat, weights = into.reshape(len(into), -1), points.weights.astype(sums.dtype)
    rows = max(_LEAST_ROWS, points.reach_px, -(-len(flat) // (_STRIPS_PER_CORE * cores())))

    def run(first: int) -> None:
        end = min(first + rows, len(flat))
        splat_strip(flat, padded, cells, points.xy, weights, points.starts, points.reach_px, origin, first, end)

    list(each(run, range(0, len(flat), rows)))
    if missing:
        sums += into[..., :channels]


def splat_plainly(
    sums: Float[np.ndarray, "rows columns channels"],
    values: Float32[np.ndarray, "height width channels"],
    cells: Int32[np.ndarray, "height width"],
    points: Points,
    origin: tuple[int, int],
) -> None:
    """The slow and obvious twin of `splat`."""
    for y, x in np.argwhere(cells >= 0):
        part = slice(points.starts[cells[y, x]], points.starts[cells[y, x] + 1])
        for (right, down), weight in zip(points.xy[part], points.weights[part], strict=True):
            sums[y + down - origin[0], x + right - origin[1]] += weight * values[y, x]
