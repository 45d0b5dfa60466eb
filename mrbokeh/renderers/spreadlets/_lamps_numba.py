"""Lamps among the pixels whose kernels are sparse, compiled."""

import numpy as np

from mrbokeh.system.kernels import njit

NONE = -1
_STRETCH_PX = 64


@njit(cache=True, nogil=True)
def add_up(sums: np.ndarray, values: np.ndarray, codes: np.ndarray, sparse: np.ndarray) -> int:
    """How many pixels of values (H, W, C) have a code (H, W) that is sparse; their light, without sign, goes onto sums (C,)."""
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
def find_lamps(found: np.ndarray, most: np.ndarray, values: np.ndarray, codes: np.ndarray, sparse: np.ndarray, limits: np.ndarray) -> None:
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
