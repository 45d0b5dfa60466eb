"""What polygon_differences must know of the tiles of a picture, once its pixels are surveyed: which hold light, and how it varies.

So little work that other threads need not be let in meanwhile, as nogil would: to get back among them takes longer.
"""

import numpy as np

from mrbokeh.renderers.polygon._survey_numba import HIGHLIGHT, TILE_PX
from mrbokeh.system.kernels import njit

compiled = njit(cache=True, error_model="numpy", _nrt=False)


@compiled
def look_over(
    sums: np.ndarray, peaks: np.ndarray, largest_px: np.ndarray, occupied: np.ndarray, darkest: np.ndarray, strongest: np.ndarray
) -> tuple[int, int, int, float, float]:
    """How many tiles hold light, the first row of them and the end, the largest diameter, and the contrast: the strongest value of
    a channel over the mean of its darkest tile that is not empty, the worst of all channels.

    sums, peaks (tiles, C), largest_px (tiles); sets occupied (tiles). darkest, strongest (C,) are scratch space.
    """
    rows, columns, channels = sums.shape
    lit, first, end, diameter_px, contrast = 0, rows, 0, np.float32(0.0), np.float32(0.0)
    darkest[:], strongest[:] = np.inf, 0.0
    for row in range(rows):
        for column in range(columns):
            occupied[row, column] = False
            diameter_px = max(diameter_px, largest_px[row, column])
            for c in range(channels):
                strongest[c] = max(strongest[c], peaks[row, column, c])
                if sums[row, column, c] > 0:
                    occupied[row, column] = True
                    darkest[c] = min(darkest[c], sums[row, column, c])
            if occupied[row, column]:
                lit, first, end = lit + 1, min(first, row), row + 1
    for c in range(channels):
        contrast = max(contrast, strongest[c] / (darkest[c] / np.float32(TILE_PX * TILE_PX)))
    return lit, first, end, float(diameter_px), float(contrast)


@compiled
def find_suspects(sums: np.ndarray, peaks: np.ndarray, largest_px: np.ndarray, from_px: float, suspects: np.ndarray) -> int:
    """Set suspects (N, 2) to the tiles (row, column) that may hold a highlight blurred by more than from_px; how many there are."""
    count, least = 0, np.float32(HIGHLIGHT)
    for row in range(sums.shape[0]):
        for column in range(sums.shape[1]):
            if largest_px[row, column] > np.float32(from_px):
                is_suspect = False
                for c in range(sums.shape[2]):
                    is_suspect = is_suspect or peaks[row, column, c] > least * sums[row, column, c]
                if is_suspect:
                    suspects[count, 0], suspects[count, 1] = row, column
                    count += 1
    return count


@compiled
def integrate(sums: np.ndarray, integral: np.ndarray) -> None:
    """Set integral (rows + 1, columns + 1, C) to the sums of all tiles above and to the left."""
    integral[0], integral[:, 0] = 0.0, 0.0
    for row in range(sums.shape[0]):
        for c in range(sums.shape[2]):
            along = 0.0
            for column in range(sums.shape[1]):
                along += sums[row, column, c]
                integral[row + 1, column + 1, c] = integral[row, column + 1, c] + along


@compiled
def find_parts(occupied: np.ndarray, rows: tuple[int, int], width: int, step: int, margin: int, parts: np.ndarray) -> int:
    """Set parts (N, 4) to the first and end row, first and end column, in pixels, of what holds light; how many there are.

    occupied: tiles. rows: first and end. Each column of `step` pixels is cut where nothing is for more than two margins.
    """
    count = 0
    for start in range(0, width, step):
        end, before, last = min(start + step, width), count, -1
        for row in range(rows[0] // TILE_PX, -(-rows[1] // TILE_PX)):
            first_tile, end_tile = width, 0
            for column in range(start // TILE_PX, -(-end // TILE_PX)):
                if occupied[row, column]:
                    first_tile, end_tile = min(first_tile, column), column + 1
            if end_tile == 0:
                continue
            if last < 0 or (row - last) * TILE_PX > 2 * margin:
                parts[count, 0], parts[count, 2], parts[count, 3] = row, first_tile, end_tile
                count += 1
            parts[count - 1, 1], last = row + 1, row
            parts[count - 1, 2], parts[count - 1, 3] = min(parts[count - 1, 2], first_tile), max(parts[count - 1, 3], end_tile)
        for i in range(before, count):
            parts[i, 0], parts[i, 1] = max(parts[i, 0] * TILE_PX, rows[0]), min(parts[i, 1] * TILE_PX, rows[1])
            parts[i, 2], parts[i, 3] = max(parts[i, 2] * TILE_PX, start), min(parts[i, 3] * TILE_PX, end)
    return count
