"""Splatting of points, compiled: every pixel adds its value times the points of its cell to an accumulator."""

import numpy as np
from numba import njit

from mrbokeh.renderers._vectors_numba import add_to_cell

NONE = -1
LANES = 4
"""Channels that are added at once."""


@njit(cache=True, nogil=True)
def _first_at_or_after(points: np.ndarray, low: int, high: int, row: int) -> int:
    """The first of points[low:high], sorted by y, with y >= row."""
    while low < high:
        middle = (low + high) // 2
        if points[middle, 1] < row:
            low = middle + 1
        else:
            high = middle
    return low


@njit(cache=True, nogil=True, error_model="numpy")
def splat_strip(
    out: np.ndarray,
    values: np.ndarray,
    cells: np.ndarray,
    points: np.ndarray,
    weights: np.ndarray,
    starts: np.ndarray,
    reach_px: int,
    origin: tuple[int, int],
    first: int,
    end: int,
) -> None:
    """Add the light that falls into rows first:end of out (h, w * C), whose first pixel is row and column `origin` of the picture.

    values (H, W, C), C a multiple of LANES, cells (H, W) or NONE. points (N, 2) x, y of cell i at starts[i]:starts[i + 1], sorted by
    y; weights (N,); none reaches farther than reach_px, and all must fall into out. Every sum is taken in the order of rows,
    columns and points, whatever the strip.
    """
    height, width, channels = values.shape
    top, left = origin
    flat, stride, element = out.reshape(-1), out.shape[1], out.dtype.type
    offsets = points[:, 1].astype(np.int64) * stride + channels * points[:, 0]
    for y in range(max(0, first + top - reach_px), min(height, end + top + reach_px)):
        low_row, high_row = first + top - y, end + top - y
        for x in range(width):
            cell = cells[y, x]
            if cell == NONE:
                continue
            low, high = starts[cell], starts[cell + 1]
            if low_row > -reach_px or high_row <= reach_px:
                low = _first_at_or_after(points, low, high, low_row)
                high = _first_at_or_after(points, low, high, high_row)
            for c in range(0, channels, LANES):
                value = (element(values[y, x, c]), element(values[y, x, c + 1]), element(values[y, x, c + 2]), element(values[y, x, c + 3]))
                here = (y - top) * stride + channels * (x - left) + c
                for n in range(low, high):
                    add_to_cell(flat, here + offsets[n], weights, n, value)


@njit(cache=True, nogil=True)
def choose_cells(
    codes: np.ndarray,
    out: np.ndarray,
    values: np.ndarray,
    coc_px: np.ndarray,
    bright: np.ndarray,
    sharp_up_to_px: float,
    dense_up_to_px: float,
    dense_per_px: float,
    levels_per_octave: float,
    blocks: int,
) -> bool:
    """Code of every pixel's kernel; what is sharp is copied to out and has none. False if a circle of confusion is not finite.

    A code is a level + blocks * kind + 3 * blocks * (in front of the focus); kinds: 0 dense, 1 sparse, 2 whole Laplacian.
    """
    height, width, channels = values.shape
    finite = True
    for y in range(height):
        for x in range(width):
            lit = False
            for c in range(channels):
                lit = lit or values[y, x, c] != 0
            size = abs(coc_px[y, x]) if lit else np.float32(0)
            codes[y, x] = NONE
            if not np.isfinite(size):
                finite = False
            elif size <= sharp_up_to_px:
                for c in range(channels):
                    out[y, x, c] = values[y, x, c]
            else:
                if size <= dense_up_to_px:
                    code = int(np.rint(size * dense_per_px))
                else:
                    code = int(np.rint(np.log2(size / dense_up_to_px) * levels_per_octave))
                    code += 2 * blocks if bright[y, x] else blocks
                codes[y, x] = code + 3 * blocks if coc_px[y, x] < 0 else code
    return finite


@njit(cache=True, nogil=True)
def find_outshining(found: np.ndarray, values: np.ndarray, around: np.ndarray, times: float) -> None:
    """Mark the pixels (H, W) of which a channel of values (H, W, C) is more than so many times that of around."""
    height, width, channels = values.shape
    for y in range(height):
        for x in range(width):
            for c in range(channels):
                found[y, x] |= abs(values[y, x, c]) > times * around[y, x, c]
