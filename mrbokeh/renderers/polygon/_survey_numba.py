"""Compiled survey of a picture before it is blurred: where light is, how strong, how it varies over tiles, and which pixels are highlights.

Loops over tiles do so little work that releasing the GIL (nogil) would cost more than it saves.
"""

import numpy as np

from mrbokeh.system.compiled import njit

TILE_PX = 8
"""Side of the tiles in which light is counted; at most the half side of the smallest window, so that a pixel's own tile lies in it."""
BLOCK_PX = 64
"""Columns that are looked at together, or not at all where nothing is."""
HIGHLIGHT = 0.05
"""From this share of all light in its window a pixel starts to be spread by its exact kernel; from twice that it is wholly."""

compiled = njit(cache=True, nogil=True, error_model="numpy", _nrt=False)


@compiled
def survey(
    values: np.ndarray,
    coc_px: np.ndarray,
    rows: tuple[int, int],
    sums: np.ndarray,
    peaks: np.ndarray,
    largest: np.ndarray,
    least: np.ndarray,
    is_full: np.ndarray,
    work: np.ndarray,
) -> None:
    """Set for some rows of tiles: absolute sums and peaks (tiles, C), largest visible diameter and whether all pixels are visible (tiles),
    least values (rows of tiles, C).

    values (H, W C); work (5, W C) is scratch space. A visible pixel without a finite diameter makes largest infinite.
    """
    for row in range(rows[0], rows[1]):
        _survey_row(values, coc_px, row, sums[row], peaks[row], largest[row], least[row], is_full[row], work)


@compiled
def _survey_row(
    values: np.ndarray,
    coc_px: np.ndarray,
    row: int,
    sums: np.ndarray,
    peaks: np.ndarray,
    largest: np.ndarray,
    least: np.ndarray,
    is_full: np.ndarray,
    work: np.ndarray,
) -> None:
    channels = least.shape[0]
    work[:4], work[4], is_full[:] = 0.0, np.inf, True
    top, bottom = row * TILE_PX, min((row + 1) * TILE_PX, values.shape[0])
    for y in range(top, bottom):
        _add_sizes(values[y], work[0])
    width = coc_px.shape[1]
    for left in range(0, width, BLOCK_PX):
        right = min(left + BLOCK_PX, width)
        block = slice(left * channels, right * channels)
        if work[0, block].any():
            for y in range(top, bottom):
                _raise_peaks(values[y, block], work[1, block])
                _lower_least(values[y, block], work[2, block])
                _raise_diameters(values[y, block], coc_px[y, left:right], channels, work[3, left:right], work[4, left:right])
            _gather(work[:, block], work[3:, left:right], left, channels, sums, peaks, largest, least, is_full)
        else:
            is_full[left // TILE_PX : -(-right // TILE_PX)] = False


@compiled
def _gather(
    work: np.ndarray,
    of_pixels: np.ndarray,
    left: int,
    channels: int,
    sums: np.ndarray,
    peaks: np.ndarray,
    largest: np.ndarray,
    least: np.ndarray,
    is_full: np.ndarray,
) -> None:
    """Gather columns of pixels into columns of tiles. of_pixels: largest diameters and least light."""
    for x in range(of_pixels.shape[1]):
        column = (left + x) // TILE_PX
        largest[column] = max(largest[column], of_pixels[0, x])
        is_full[column] = is_full[column] and of_pixels[1, x] > 0
        for c in range(channels):
            i = x * channels + c
            sums[column, c] += work[0, i]
            peaks[column, c] = max(peaks[column, c], work[1, i])
            least[c] = min(least[c], work[2, i])


# One array to a loop, so that each is compiled to vectors: together they took ten times as long.


@compiled
def _add_sizes(line: np.ndarray, total: np.ndarray) -> None:
    for i in range(line.shape[0]):
        total[i] += abs(line[i])


@compiled
def _raise_peaks(line: np.ndarray, peak: np.ndarray) -> None:
    for i in range(line.shape[0]):
        peak[i] = abs(line[i]) if abs(line[i]) > peak[i] else peak[i]


@compiled
def _lower_least(line: np.ndarray, least: np.ndarray) -> None:
    for i in range(line.shape[0]):
        least[i] = line[i] if line[i] < least[i] else least[i]


@compiled
def _raise_diameters(line: np.ndarray, coc_px: np.ndarray, channels: int, largest: np.ndarray, dimmest: np.ndarray) -> None:
    infinite, zero = np.float32(np.inf), np.float32(0.0)
    for x in range(coc_px.shape[0]):
        diameter = abs(coc_px[x])
        diameter = diameter if diameter < infinite else infinite
        light = zero
        if channels == 4:
            light = abs(line[4 * x]) + abs(line[4 * x + 1]) + abs(line[4 * x + 2]) + abs(line[4 * x + 3])
        else:
            for i in range(x * channels, (x + 1) * channels):
                light += abs(line[i])
        diameter = diameter if light > zero else zero
        dimmest[x] = light if light < dimmest[x] else dimmest[x]
        largest[x] = diameter if diameter > largest[x] else largest[x]


@compiled
def find_highlights(
    values: np.ndarray, coc_px: np.ndarray, suspects: np.ndarray, integral: np.ndarray, from_px: float, share: np.ndarray
) -> bool:
    """Set share (H, W) of the pixels in suspect tiles (row, column): how much of each is splatted by its exact kernel.

    A pixel's window is the square of four radii around it. integral (tile rows + 1, tile columns + 1, C): of the sums.
    Only smooth functions of what lies in the window count, so that nothing pops and moved pictures give moved results.
    Returns whether there are any.
    """
    height, width, channels = values.shape
    is_any = False
    for suspect in range(suspects.shape[0]):
        for y in range(suspects[suspect, 0] * TILE_PX, min((suspects[suspect, 0] + 1) * TILE_PX, height)):
            for x in range(suspects[suspect, 1] * TILE_PX, min((suspects[suspect, 1] + 1) * TILE_PX, width)):
                if abs(coc_px[y, x]) > from_px:
                    ratio = 0.0
                    for c in range(channels):
                        if values[y, x, c] != 0:
                            ratio = max(ratio, _share_of_window(values, integral, y, x, c, int(abs(coc_px[y, x]))))
                    share[y, x] = min(max(ratio / HIGHLIGHT - 1.0, 0.0), 1.0)
                    is_any = is_any or share[y, x] > 0
    return is_any


@compiled
def _share_of_window(values: np.ndarray, integral: np.ndarray, y: int, x: int, c: int, reach: int) -> float:
    """Return the share that one pixel gives of all light within `reach`; 0 if it is certainly too little to count."""
    height, width, _ = values.shape
    top, bottom, left, right = max(0, y - reach), min(height, y + reach + 1), max(0, x - reach), min(width, x + reach + 1)
    value = abs(values[y, x, c])
    first_row, end_row = -(-top // TILE_PX), bottom // TILE_PX
    first_column, end_column = -(-left // TILE_PX), right // TILE_PX
    if end_row > first_row and end_column > first_column:
        inside = integral[end_row, end_column, c] - integral[first_row, end_column, c]
        inside -= integral[end_row, first_column, c] - integral[first_row, first_column, c]
        if value <= HIGHLIGHT * inside:
            return 0.0
    total = 0.0
    for j in range(top, bottom):
        for i in range(left, right):
            total += abs(values[j, i, c])
    return float(value / total)


_compiled_holding = njit(cache=True, error_model="numpy", _nrt=False)


@_compiled_holding
def look_over(
    sums: np.ndarray, peaks: np.ndarray, largest_px: np.ndarray, occupied: np.ndarray, darkest: np.ndarray, strongest: np.ndarray
) -> tuple[int, int, int, float, float]:
    """Return how many tiles hold light, the first row of them and the end, the largest diameter, and the contrast: the strongest value of
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


@_compiled_holding
def find_suspects(sums: np.ndarray, peaks: np.ndarray, largest_px: np.ndarray, from_px: float, suspects: np.ndarray) -> int:
    """Set suspects (N, 2) to the tiles (row, column) that may hold a highlight blurred by more than from_px, and return their number."""
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


@_compiled_holding
def integrate(sums: np.ndarray, integral: np.ndarray) -> None:
    """Set integral (rows + 1, columns + 1, C) to the sums of all tiles above and to the left."""
    integral[0], integral[:, 0] = 0.0, 0.0
    for row in range(sums.shape[0]):
        for c in range(sums.shape[2]):
            along = 0.0
            for column in range(sums.shape[1]):
                along += sums[row, column, c]
                integral[row + 1, column + 1, c] = integral[row, column + 1, c] + along


@_compiled_holding
def find_parts(occupied: np.ndarray, rows: tuple[int, int], width: int, step: int, margin: int, parts: np.ndarray) -> int:
    """Set parts (N, 4) to the first and end row, first and end column, in pixels, of what holds light, and return their number.

    occupied: tiles. rows: first and end. Each column of `step` pixels is cut where it is dark for more than two margins.
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
