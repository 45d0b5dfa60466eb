"""Filtered layers of a tile laid behind one another, and what none of them claims."""

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True)
def composite(out: np.ndarray, seen_past: np.ndarray, layer: np.ndarray) -> None:
    """Lay a filtered layer (h, w, C + 2) behind what out (h, w, C) holds; seen_past (h, w) is the product of 1 - alpha so far."""
    height, width, channels = out.shape
    for y in range(height):
        for x in range(width):
            weight = layer[y, x, channels + 1]
            if weight <= 1e-6:
                continue
            share = seen_past[y, x] / weight
            for c in range(channels):
                out[y, x, c] += share * layer[y, x, c]
            seen_past[y, x] *= max(0.0, 1.0 - layer[y, x, channels] / weight)


@njit(cache=True, nogil=True)
def share_out(out: np.ndarray, seen_past: np.ndarray) -> None:
    """Behind the last layer is nothing that was sampled: what no layer claims belongs to those that were seen."""
    height, width, channels = out.shape
    for y in range(height):
        for x in range(width):
            taken = 1.0 - seen_past[y, x]
            if taken > 1e-3:
                for c in range(channels):
                    out[y, x, c] /= taken


@njit(cache=True, nogil=True)
def own_means(
    out: np.ndarray, seen_past: np.ndarray, left: int, top: int, first: int, end: int, geometry: np.ndarray, values: np.ndarray
) -> None:
    """A pixel that no layer reaches shows the mean of its own samples."""
    height, width, channels = out.shape
    counts = np.zeros((height, width), np.int32)
    for i in range(first, end):
        x, y = min(int(geometry[i, 0]) - left, width - 1), min(int(geometry[i, 1]) - top, height - 1)
        if seen_past[y, x] >= 0.999:
            if counts[y, x] == 0:
                out[y, x, :] = 0.0
            counts[y, x] += 1
            for c in range(channels):
                out[y, x, c] += (values[i, c] - out[y, x, c]) / counts[y, x]
