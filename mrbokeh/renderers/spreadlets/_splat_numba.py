"""Compiled loops of Laplacian spreadlets: points splatted, sums converted to integers and back, highlights among the pixels.

Every pixel adds its value times the points of its cell to an accumulator.
"""

import numpy as np

from mrbokeh.renderers.spreadlets._points_numba import add_points, add_points_of_two
from mrbokeh.system.kernels import njit

NONE = -1
_STRETCH_PX = 64
LANES = 4
"""Channels that are added at once."""
_MOST_BESIDE = 0.25
_TILE_ROWS, _TILE_COLUMNS = 64, 32
_ALONG, _DOWN = 0.7548776662466927, 0.5698402909980532  # a lattice whose points are spread evenly over any area (Roberts 2018, R2)


@njit(cache=True, nogil=True)
def rows_of(points: np.ndarray, starts: np.ndarray, reach_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Return where each row of a cell's points begins, and whether its points lie apart.

    points (N, 2), cell i at starts[i]:starts[i + 1] sorted by y. Returns (cells, 2 reach + 2): the first point with y >= k - reach;
    (cells,): False where many points have one right beside them, so that two neighbouring pixels at once would write onto what
    was just written, for which processors wait.
    """
    cells = len(starts) - 1
    rows, apart = np.empty((cells, 2 * reach_px + 2), np.int32), np.empty(cells, np.bool_)
    for cell in range(cells):
        n, beside = starts[cell], 0
        for k in range(2 * reach_px + 2):
            while n < starts[cell + 1] and points[n, 1] < k - reach_px:
                n += 1
            rows[cell, k] = n
        for n in range(starts[cell] + 1, starts[cell + 1]):
            beside += points[n, 1] == points[n - 1, 1] and points[n, 0] == points[n - 1, 0] + 1
        apart[cell] = beside <= _MOST_BESIDE * (starts[cell + 1] - starts[cell])
    return rows, apart


@njit(cache=True, nogil=True)
def dither_of(x: int, y: int) -> np.float32:
    """Return how a pixel rounds, within +-0.5: neighbours differ, and any area has about as much of each."""
    phase = _ALONG * x + _DOWN * y
    return np.float32(phase - np.rint(phase))


@njit(cache=True, nogil=True, error_model="numpy")
def splat_strip(
    out: np.ndarray,
    values: np.ndarray,
    cells: np.ndarray,
    offsets: np.ndarray,
    weights: np.ndarray,
    rows: np.ndarray,
    apart: np.ndarray,
    gains: np.ndarray,
    origin: tuple[int, int],
    first: int,
    end: int,
) -> None:
    """Add the light that falls into rows first:end of out (h, w, LANES), whose first pixel is row and column `origin` of the picture.

    values (H, W, LANES) single precision, cells (H, W) or NONE. offsets (N,) int32 of points from their pixel in the flat array,
    weights, gains: see `add_points`; rows and apart as from `rows_of`; all points must fall into out. Tile by tile, so that what a
    tile reaches stays in the cache. Every sum is taken in the order of tiles, rows, columns and points, neighbours of one cell together,
    whatever the strip.
    """
    height, width = cells.shape
    top, left = origin
    reach_px = rows.shape[1] // 2 - 1
    flat, light, stride = out.reshape(-1), values.reshape(-1), LANES * out.shape[1]
    first_row, end_row = max(0, first + top - reach_px), min(height, end + top + reach_px)
    for tile in range(first_row // _TILE_ROWS * _TILE_ROWS, end_row, _TILE_ROWS):
        for first_column in range(0, width, _TILE_COLUMNS):
            for y in range(max(tile, first_row), min(tile + _TILE_ROWS, end_row)):
                low_row, high_row = max(0, first + top - y + reach_px), min(2 * reach_px + 1, end + top - y + reach_px)
                x, end_column = first_column, min(first_column + _TILE_COLUMNS, width)
                while x < end_column:
                    cell = cells[y, x]
                    if cell == NONE:
                        x += 1
                        continue
                    low, high = rows[cell, low_row], rows[cell, high_row]
                    here, at = (y - top) * stride + LANES * (x - left), LANES * (y * width + x)
                    dithers = dither_of(x, y), dither_of(x + 1, y)
                    if x + 1 < end_column and cells[y, x + 1] == cell and apart[cell]:
                        add_points_of_two(flat, here, offsets, weights, low, high, light, at, gains, dithers)
                        x += 2
                    else:
                        add_points(flat, here, offsets, weights, low, high, light, at, gains, dithers)
                        x += 1


@njit(cache=True, nogil=True)
def add_and_clear(out: np.ndarray, sums: np.ndarray, origin: tuple[int, int], first: int, end: int) -> None:
    """Add rows first:end of sums (h, w, LANES), as far as they fall into out (H, W, up to LANES), and make them zero."""
    height, width, channels = out.shape
    top, left = origin
    for y in range(first, end):
        if 0 <= y + top < height:
            for x in range(max(0, left), min(width, left + sums.shape[1])):
                for c in range(channels):
                    out[y + top, x, c] += sums[y, x - left, c]
        sums[y] = 0.0


@njit(cache=True, nogil=True)
def largest_sum(points: np.ndarray, weights: np.ndarray, reach_px: int) -> float:
    """Return a bound on the sum of points (N, 2) times light of at most 1, whichever cell every pixel around takes."""
    side = 2 * reach_px + 1
    most = np.zeros((side, side))
    for n in range(len(weights)):
        y, x = points[n, 1] + reach_px, points[n, 0] + reach_px
        most[y, x] = max(most[y, x], abs(weights[n]))
    return most.sum()


@njit(cache=True, nogil=True)
def to_reals(whole: np.ndarray, reals: np.ndarray, gains: np.ndarray) -> None:
    """Set reals (h, w, LANES) to whole (h, w, LANES) over gains (LANES,), powers of two; they may lie in the same memory."""
    height, width, lanes = whole.shape
    row, unit = np.empty(width * lanes, np.float32), np.empty(width * lanes, np.float32)
    for i in range(len(unit)):
        unit[i] = 1.0 / gains[i % lanes]
    for y in range(height):
        source, target = whole[y].reshape(-1), reals[y].reshape(-1)
        for i in range(len(row)):
            row[i] = source[i]
        for i in range(len(row)):
            target[i] = row[i] * unit[i]


@njit(cache=True, nogil=True)
def add_up(sums: np.ndarray, values: np.ndarray, codes: np.ndarray, sparse: np.ndarray) -> int:
    """Add the light, without sign, of pixels of values (H, W, C) whose code (H, W) is sparse to sums (C,), and return their number."""
    height, width, channels = values.shape
    count = 0
    for y in range(height):
        for x in range(width):
            code = codes[y, x]
            if code != NONE and sparse[code]:
                count += 1
                for c in range(channels):
                    sums[c] += abs(values[y, x, c])
    return count


@njit(cache=True, nogil=True)
def mark_highlights(
    found: np.ndarray, most: np.ndarray, values: np.ndarray, codes: np.ndarray, sparse: np.ndarray, limits: np.ndarray
) -> None:
    """Mark the sparse pixels with a channel beyond its limit (C,); no other light is larger than most (C,), NaN if some is NaN.

    Stretches without anything beyond the limits are passed in vectors, whatever their codes.
    """
    height, width, channels = values.shape
    limit, highest = np.empty(_STRETCH_PX * channels, np.float32), np.zeros(_STRETCH_PX * channels, np.float32)
    for i in range(len(limit)):
        limit[i] = limits[i % channels]
    for y in range(height):
        row = values[y].reshape(-1)
        for first in range(0, width, _STRETCH_PX):
            end = min(first + _STRETCH_PX, width)
            here, within = row[first * channels : end * channels], 0
            for i in range(len(here)):
                within += abs(here[i]) <= limit[i]
            if within == len(here):
                for i in range(len(here)):
                    highest[i] = max(highest[i], abs(here[i]))
            else:
                for x in range(first, end):
                    if codes[y, x] != NONE and sparse[codes[y, x]]:
                        _look_at(found[y], most, values[y], x, limits)
    for i in range(len(highest)):
        most[i % channels] = max(most[i % channels], highest[i]) if most[i % channels] == most[i % channels] else most[i % channels]


@njit(cache=True, nogil=True)
def _look_at(found: np.ndarray, most: np.ndarray, values: np.ndarray, x: int, limits: np.ndarray) -> None:
    for c in range(len(limits)):
        found[x] |= abs(values[x, c]) > limits[c]
    if not found[x]:
        for c in range(len(limits)):
            light = abs(values[x, c])
            if light > most[c] or light != light:
                most[c] = light
