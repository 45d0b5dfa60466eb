"""The loops over pixels of mrbokeh.slices, compiled: sorting a layer into slices and handing out the free pupil."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def slice_windows(
    windows: np.ndarray, largest_px: np.ndarray, index: np.ndarray, weight: np.ndarray, values: np.ndarray, coc_px: np.ndarray, lowest: int
) -> None:
    """Widen windows (slices, 4: first and end row, first and end column) and largest diameters (slices) by a sheet's weighty pixels."""
    height, width = index.shape
    for y in range(height):
        for x in range(width):
            if weight[y, x] > 0.0 and values[y, x, 3] > 0.0:
                place = index[y, x] - lowest
                window = windows[place]
                window[0], window[1] = min(window[0], y), max(window[1], y + 1)
                window[2], window[3] = min(window[2], x), max(window[3], x + 1)
                largest_px[place] = max(largest_px[place], abs(coc_px[y, x]))


@njit(cache=True, nogil=True)
def place_slice(
    light: np.ndarray,
    light_coc_px: np.ndarray,
    full: np.ndarray,
    values: np.ndarray,
    coc_px: np.ndarray,
    weight: np.ndarray,
    index: np.ndarray,
    slice_index: int,
) -> bool:
    """Put a sheet's pixels of a slice, times their weight, into light (h, w, C) where it is not full; what was put has no weight any more.

    True if some pixels found their place full and still wait.
    """
    height, width, channels = values.shape
    waiting = False
    for y in range(height):
        for x in range(width):
            share = weight[y, x]
            if index[y, x] != slice_index or share <= 0.0 or values[y, x, 3] <= 0.0:
                continue
            if full[y, x]:
                waiting = True
                continue
            full[y, x], weight[y, x], light_coc_px[y, x] = True, 0.0, coc_px[y, x]
            for c in range(channels):
                light[y, x, c] = values[y, x, c] * share
    return waiting


@njit(cache=True, nogil=True)
def claim(colour: np.ndarray, taken: np.ndarray, light: np.ndarray) -> None:
    """Let light (h, w, 3 + K + E) take what is still free of the pupil; in place on colour (h, w, 3 + E) and taken (h, w, K), K 1 or 3."""
    height, width, colours = colour.shape
    kinds = taken.shape[2]
    for y in range(height):
        for x in range(width):
            for c in range(colours):
                kind = min(c, kinds - 1) if c < 3 else kinds // 2
                coverage = light[y, x, 3 + kind]
                if coverage <= 0.0:
                    continue
                share = min(np.float32(1.0), (np.float32(1.0) - taken[y, x, kind]) / coverage)
                source = c if c < 3 else c + kinds
                colour[y, x, c] += light[y, x, source] * share
            for kind in range(kinds):
                taken[y, x, kind] = min(np.float32(1.0), taken[y, x, kind] + max(np.float32(0.0), light[y, x, 3 + kind]))
