"""The segment that a partition moves along while the shutter is open, or a stretch of it, over the screen."""

import math

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True)
def line_taps(length_x: float, length_y: float, begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (T, 2) and weights, sum 1, of the pixels that a segment centred on a pixel crosses from `begin` to `end`, both from
    -1/2 to 1/2 of its length, by the length within each."""
    reach_x, reach_y = int(math.ceil(0.5 * abs(length_x))), int(math.ceil(0.5 * abs(length_y)))
    kernel = np.zeros((2 * reach_y + 1, 2 * reach_x + 1))
    cuts = np.empty(2 * (reach_x + reach_y) + 2)
    cuts[0], cuts[1] = begin, end
    count = 2
    for length, reach in ((length_x, reach_x), (length_y, reach_y)):
        for k in range(reach):
            at = (k + 0.5) / abs(length)
            for cut in (-at, at):
                if begin < cut < end:
                    cuts[count] = cut
                    count += 1
    cuts = np.sort(cuts[:count])
    for k in range(count - 1):
        middle = 0.5 * (cuts[k] + cuts[k + 1])
        x, y = int(math.floor(middle * length_x + 0.5)), int(math.floor(middle * length_y + 0.5))
        kernel[y + reach_y, x + reach_x] += (cuts[k + 1] - cuts[k]) / (end - begin)
    rows, columns = np.nonzero(kernel > 0.0)
    weights = np.empty(len(rows), np.float32)
    offsets = np.empty((len(rows), 2), np.int64)
    for k in range(len(rows)):
        weights[k] = kernel[rows[k], columns[k]]
        offsets[k, 0], offsets[k, 1] = columns[k] - reach_x, rows[k] - reach_y
    return offsets, weights


@njit(cache=True, nogil=True)
def along_line(out: np.ndarray, planes: np.ndarray, offsets: np.ndarray, weights: np.ndarray, guard_x: int, guard_y: int) -> None:
    """Fill out (h, w, C) with the mean of planes (h + 2 guard_y, w + 2 guard_x, C) along a segment."""
    height, width, channels = out.shape
    out[:] = 0.0
    from_flat, to_flat = planes.reshape(-1), out.reshape(-1)
    length, across = np.uint64(width * channels), np.uint64(planes.shape[1] * channels)
    for k in range(len(weights)):
        weight = weights[k]
        line = np.uint64(guard_y + offsets[k, 1]) * across + np.uint64((guard_x + offsets[k, 0]) * channels)
        to = np.uint64(0)
        for _ in range(height):
            for n in range(length):
                to_flat[to + n] += weight * from_flat[line + n]
            line, to = line + across, to + length
