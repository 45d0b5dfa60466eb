"""Compiled loops that halve the resolution of what is far out of focus, and double it again.

Blocks of 2 x 2 pixels are chosen that are far out of focus, and evenly so. Cell (j, i) of the half picture covers the block of pixels
(2 j - 2, 2 i - 2) to (2 j - 1, 2 i - 1): there is one more cell on every side. A pixel gives 3/4 of its light to the cell that covers
it and 1/4 to the next nearest, in each direction, which keeps the centre of its light where it is; pixels take from cells by the same
shares.
"""

import numpy as np

from mrbokeh.renderers.polygon._ring_numba import compiled
from mrbokeh.renderers.polygon._survey_numba import TILE_PX


@compiled
def measure_blocks(
    values: np.ndarray,
    coc_px: np.ndarray,
    largest_px: np.ndarray,
    is_full: np.ndarray,
    tile_rows: tuple[int, int],
    limits: tuple[float, float, float],
    lowest: np.ndarray,
    highest: np.ndarray,
) -> None:
    """Set the least and greatest signed diameter among the pixels with light of each block of some rows of tiles; inf and -inf without any.

    limits: see choose_blocks. Tiles (largest_px, is_full: whether all pixels have light) whose largest diameter does not exceed
    limits[0] are not looked at but taken as in focus.
    """
    for tile_row in range(tile_rows[0], tile_rows[1]):
        _measure_tiles(values, coc_px, largest_px[tile_row], is_full[tile_row], tile_row, limits, lowest, highest)


@compiled
def _measure_tiles(
    values: np.ndarray,
    coc_px: np.ndarray,
    largest_px: np.ndarray,
    is_full: np.ndarray,
    tile_row: int,
    limits: tuple[float, float, float],
    lowest: np.ndarray,
    highest: np.ndarray,
) -> None:
    first_row, end_row = tile_row * TILE_PX // 2, min((tile_row + 1) * TILE_PX // 2, lowest.shape[0])
    for tile in range(largest_px.shape[0]):
        tile_lowest = lowest[first_row:end_row, tile * TILE_PX // 2 : (tile + 1) * TILE_PX // 2]
        tile_highest = highest[first_row:end_row, tile * TILE_PX // 2 : (tile + 1) * TILE_PX // 2]
        if largest_px[tile] <= limits[0]:
            tile_lowest[:], tile_highest[:] = 0.0, 0.0
            continue
        if is_full[tile]:
            _measure_all(coc_px, 2 * first_row, tile * TILE_PX, tile_lowest, tile_highest)
        else:
            _measure_lit(values, coc_px, 2 * first_row, tile * TILE_PX, tile_lowest, tile_highest)


@compiled
def _measure_all(coc_px: np.ndarray, top: int, left: int, lowest: np.ndarray, highest: np.ndarray) -> None:
    for row in range(lowest.shape[0]):
        y, below = top + 2 * row, min(top + 2 * row + 1, coc_px.shape[0] - 1)
        for column in range(lowest.shape[1]):
            x, right = left + 2 * column, min(left + 2 * column + 1, coc_px.shape[1] - 1)
            lowest[row, column] = min(min(coc_px[y, x], coc_px[y, right]), min(coc_px[below, x], coc_px[below, right]))
            highest[row, column] = max(max(coc_px[y, x], coc_px[y, right]), max(coc_px[below, x], coc_px[below, right]))


@compiled
def _measure_lit(values: np.ndarray, coc_px: np.ndarray, top: int, left: int, lowest: np.ndarray, highest: np.ndarray) -> None:
    lowest[:], highest[:] = np.inf, -np.inf
    for y in range(top, min(top + 2 * lowest.shape[0], coc_px.shape[0])):
        for x in range(left, min(left + 2 * lowest.shape[1], coc_px.shape[1])):
            if values[y, x, 0] != 0 or values[y, x, 1] != 0 or values[y, x, 2] != 0 or values[y, x, 3] != 0:
                row, column = (y - top) // 2, (x - left) // 2
                lowest[row, column] = min(lowest[row, column], coc_px[y, x])
                highest[row, column] = max(highest[row, column], coc_px[y, x])


@compiled
def choose_blocks(
    lowest: np.ndarray,
    highest: np.ndarray,
    tile_rows: tuple[int, int],
    limits: tuple[float, float, float],
    share: np.ndarray,
    weighted_px: np.ndarray,
    largest_px: np.ndarray,
    kept: np.ndarray,
    work: np.ndarray,
) -> None:
    """Set for some rows of tiles the share of each block's light that is halved, its product with the diameter, and what is left.

    limits: (from_px, to_px, tolerance); the share rises from 0 at from_px to 1 at to_px, where diameters around the block differ by at
    most tolerance. largest_px (tiles) is lowered to that of pixels that are not halved wholly; kept: whether there are any. work (2,
    columns of blocks + 2) is scratch space.
    """
    rows, columns = lowest.shape
    work[0], work[1] = np.inf, -np.inf
    for row in range(tile_rows[0] * TILE_PX // 2, min(tile_rows[1] * TILE_PX // 2, rows)):
        above, below = max(row - 1, 0), min(row + 1, rows - 1)
        for x in range(columns):
            work[0, x + 1] = min(lowest[row, x], min(lowest[above, x], lowest[below, x]))
            work[1, x + 1] = max(highest[row, x], max(highest[above, x], highest[below, x]))
        _choose(lowest[row], highest[row], work[0], work[1], limits, share[row], weighted_px[row])
    for tile_row in range(tile_rows[0], tile_rows[1]):
        _keep_rest(lowest, highest, tile_row, share, largest_px[tile_row], kept[tile_row])


@compiled
def _choose(
    lowest: np.ndarray,
    highest: np.ndarray,
    lows: np.ndarray,
    highs: np.ndarray,
    limits: tuple[float, float, float],
    share: np.ndarray,
    weighted_px: np.ndarray,
) -> None:
    from_px, per_px, tolerance = np.float32(limits[0]), np.float32(1.0 / (limits[1] - limits[0])), np.float32(limits[2])
    half, one, zero = np.float32(0.5), np.float32(1.0), np.float32(0.0)
    for x in range(share.shape[0]):
        around = max(highs[x], max(highs[x + 1], highs[x + 2])) - min(lows[x], min(lows[x + 1], lows[x + 2]))
        least = min(abs(lowest[x]), abs(highest[x]))
        risen = min(max((least - from_px) * per_px, zero), one)
        risen = risen if around <= tolerance * least and least < np.inf else zero
        share[x] = risen
        weighted_px[x] = half * (lowest[x] + highest[x]) * risen if risen > zero else zero


@compiled
def _keep_rest(lowest: np.ndarray, highest: np.ndarray, tile_row: int, share: np.ndarray, largest_px: np.ndarray, kept: np.ndarray) -> None:
    rows, columns = lowest.shape
    for tile in range(largest_px.shape[0]):
        largest, any_kept = np.float32(0.0), False
        for row in range(tile_row * TILE_PX // 2, min((tile_row + 1) * TILE_PX // 2, rows)):
            for x in range(tile * TILE_PX // 2, min((tile + 1) * TILE_PX // 2, columns)):
                if share[row, x] < 1 and lowest[row, x] < np.inf:
                    any_kept, largest = True, max(largest, max(abs(lowest[row, x]), abs(highest[row, x])))
        kept[tile] = any_kept
        if largest > 0 or not any_kept:
            largest_px[tile] = largest


NEAR, FAR = np.float32(0.75), np.float32(0.25)
ONE, SIX = np.float32(1.0), np.float32(6.0)
"""Shares, in eighths, of the light of a block next to a cell's own, and of the cell's own block, that the cell gets."""


@compiled
def halve_rows(
    values: np.ndarray, highlights: np.ndarray, share: np.ndarray, rows: tuple[int, int], line: np.ndarray, half: np.ndarray
) -> None:
    """Set some rows of cells, half (rows, 4 cells), to the light that is halved. values (H, 4 W); line (4 W + 24) is scratch space."""
    for row in range(rows[0], rows[1]):
        line[:] = 0.0
        for k in range(4):
            y = 2 * row - 3 + k
            if 0 <= y < values.shape[0]:
                weight = NEAR if k == 1 or k == 2 else FAR
                _add_row_taken(line[12:], values[y], share[y // 2], weight)
                if highlights.shape[0] > 0:
                    _give_back(line[12:], values[y], highlights[y], weight, share[y // 2])
        for i in range(half.shape[1] // 4):
            for c in range(4):
                at = 8 * i + c
                half[row, 4 * i + c] = FAR * (line[at] + line[at + 12]) + NEAR * (line[at + 4] + line[at + 8])


@compiled
def _add_row_taken(line: np.ndarray, values: np.ndarray, share: np.ndarray, weight: float) -> None:
    """Add the light taken from a row, blocks of one share together."""
    start = 0
    for block in range(1, share.shape[0] + 1):
        if block == share.shape[0] or share[block] != share[start]:
            if share[start] > 0:
                _add_taken(line[8 * start :], values[8 * start : 8 * block], weight * share[start])
            start = block


@compiled
def _add_taken(line: np.ndarray, values: np.ndarray, weight: float) -> None:
    for i in range(values.shape[0]):
        line[i] += weight * values[i]


@compiled
def _give_back(line: np.ndarray, values: np.ndarray, highlights: np.ndarray, weight: float, of_blocks: np.ndarray) -> None:
    """Give back the light of highlights, which is splatted elsewhere."""
    for x in range(highlights.shape[0]):
        if highlights[x] > 0:
            for c in range(4):
                line[4 * x + c] -= weight * of_blocks[x // 2] * highlights[x] * values[4 * x + c]


@compiled
def halve_diameters(share: np.ndarray, weighted_px: np.ndarray, rows: tuple[int, int], work: np.ndarray, half_coc_px: np.ndarray) -> None:
    """Set for some rows of cells the mean diameter, in cells, of the light they get, as if it were even within a block.

    work (2, cells + 2) is scratch space.
    """
    half = np.float32(0.5)
    for row in range(rows[0], rows[1]):
        work[:] = 0.0
        for y in range(max(row - 2, 0), min(row + 1, share.shape[0])):
            weight = SIX if y == row - 1 else ONE
            for x in range(share.shape[1]):
                work[0, x + 2] += weight * share[y, x]
                work[1, x + 2] += weight * weighted_px[y, x]
        weights, summed = work[0], work[1]
        for i in range(half_coc_px.shape[1]):
            weight = weights[i] + SIX * weights[i + 1] + weights[i + 2]
            diameter = summed[i] + SIX * summed[i + 1] + summed[i + 2]
            half_coc_px[row, i] = half * diameter / (weight if weight > 0 else ONE)


@compiled
def add_doubled_row(half: np.ndarray, y: int, line: np.ndarray, out: np.ndarray) -> None:
    """Add row y of the picture of which half (rows, 4 cells) is the half one: a quarter of a cell's light falls on each pixel.

    line (4 cells) is scratch space.
    """
    near, next_ = y // 2 + 1, (y // 2 if y % 2 == 0 else y // 2 + 2)
    quarter = np.float32(0.25)
    for i in range(line.shape[0]):
        line[i] = quarter * (NEAR * half[near, i] + FAR * half[next_, i])
    for pair in range(out.shape[0] // 8):
        for c in range(4):
            before, here, after = line[4 * pair + c], line[4 * pair + 4 + c], line[4 * pair + 8 + c]
            out[8 * pair + c] += NEAR * here + FAR * before
            out[8 * pair + 4 + c] += NEAR * here + FAR * after
    if out.shape[0] % 8:
        last = out.shape[0] // 8
        for c in range(4):
            out[8 * last + c] += NEAR * line[4 * last + 4 + c] + FAR * line[4 * last + c]
