"""Splatting of points, compiled: every pixel adds its value times the points of its cell to an accumulator."""

import numpy as np

from mrbokeh.renderers.spreadlets._points_numba import add_points, add_points_of_two
from mrbokeh.system.kernels import njit

NONE = -1
LANES = 4
"""Channels that are added at once."""
_MOST_BESIDE = 0.25
_TILE_ROWS, _TILE_COLUMNS = 64, 32
_ALONG, _DOWN = 0.7548776662466927, 0.5698402909980532  # a lattice whose points are spread evenly over any area (Roberts 2018, R2)


@njit(cache=True, nogil=True)
def rows_of(points: np.ndarray, starts: np.ndarray, reach_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Where each row of a cell's points begins, and whether its points lie apart.

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
    """How a pixel rounds, within +-0.5: neighbours differ, and any area has about as much of each."""
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
