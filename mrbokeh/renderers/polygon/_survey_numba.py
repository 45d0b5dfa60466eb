"""What polygon_differences must know of a picture before it is spread: where light is, how strong, and which pixels are highlights."""

import numpy as np

from mrbokeh.system.kernels import njit

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
    """Some rows of tiles: absolute sums and peaks (tiles, C), largest visible diameter and whether all pixels are visible (tiles),
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
    """From columns of pixels to columns of tiles. of_pixels: largest diameters and least light."""
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
    """Set share (H, W) of the pixels in suspect tiles (row, column): how much of each is spread by its exact kernel.

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
    """Of all light within `reach` the share that one pixel gives; 0 where it is certainly too little to count."""
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
