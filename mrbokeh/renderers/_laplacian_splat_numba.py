"""Splatting of points, compiled: every pixel adds its value times the points of its cell to an accumulator."""

import numpy as np
from numba import njit

TILE_PX = 16
NONE = -1


@njit(cache=True, nogil=True, fastmath={"contract"})
def _add(out: np.ndarray, weight: float, light: np.ndarray) -> None:
    for i in range(out.shape[0]):
        out[i] += weight * light[i]


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


@njit(cache=True, nogil=True)
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

    values (H, W, C), cells (H, W) or NONE. points (N, 2) x, y of cell i at starts[i]:starts[i + 1], sorted by y; weights (N,);
    none reaches farther than reach_px, and all must fall into out. Neighbours of one cell within a tile go together: a point
    is one run of multiplications, in which pixels of other cells take part with 0. Every sum is taken in the order of rows,
    tiles and points, whatever the strip.
    """
    height, width, channels = values.shape
    light = np.zeros(TILE_PX * channels, out.dtype)
    done = np.zeros(TILE_PX, np.bool_)
    top, left = origin
    for y in range(max(0, first + top - reach_px), min(height, end + top + reach_px)):
        low_row, high_row = first + top - y, end + top - y
        for begin in range(0, width, TILE_PX):
            size = min(TILE_PX, width - begin)
            done[:] = False
            for i in range(size):
                cell = cells[y, begin + i]
                if cell == NONE or done[i]:
                    continue
                low = _first_at_or_after(points, starts[cell], starts[cell + 1], low_row)
                high = _first_at_or_after(points, low, starts[cell + 1], high_row)
                last = i
                for j in range(i, size):
                    if cells[y, begin + j] == cell and not done[j]:
                        done[j], last = True, j
                        for c in range(channels):
                            light[(j - i) * channels + c] = values[y, begin + j, c]
                    else:
                        for c in range(channels):
                            light[(j - i) * channels + c] = 0.0
                length = (last - i + 1) * channels
                run = light[:length]
                for n in range(low, high):
                    at = (begin + i + points[n, 0] - left) * channels
                    _add(out[y + points[n, 1] - top, at : at + length], weights[n], run)


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
