"""The loops over pixels of mrbokeh.slices, compiled: sorting a layer into slices and handing out the free pupil."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def slice_windows(index: np.ndarray, weight: np.ndarray, values: np.ndarray, lowest: int, highest: int) -> np.ndarray:
    """(slices, 4) int64: first row, end row, first column, end column of the covered, weighty pixels of each; empty where end <= first."""
    height, width = index.shape
    windows = np.empty((highest - lowest + 1, 4), np.int64)
    windows[:, 0], windows[:, 1], windows[:, 2], windows[:, 3] = height, 0, width, 0
    for y in range(height):
        for x in range(width):
            if weight[y, x] > 0.0 and values[y, x, 3] > 0.0:
                window = windows[index[y, x] - lowest]
                window[0], window[1] = min(window[0], y), max(window[1], y + 1)
                window[2], window[3] = min(window[2], x), max(window[3], x + 1)
    return windows


@njit(cache=True, nogil=True)
def pick_slice(picked: np.ndarray, values: np.ndarray, weight: np.ndarray, index: np.ndarray, slice_index: int) -> None:
    """Overwrite picked (h, w, C) with values times weight where the pixel belongs to the slice, with 0 elsewhere."""
    height, width, channels = values.shape
    for y in range(height):
        for x in range(width):
            share = weight[y, x] if index[y, x] == slice_index else np.float32(0.0)
            for c in range(channels):
                picked[y, x, c] = values[y, x, c] * share if share > 0.0 else np.float32(0.0)


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
