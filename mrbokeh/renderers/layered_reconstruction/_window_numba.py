"""The true shapes of pupil and shutter over the screen, in place of the Gaussians that stand for them."""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def add_spans(out: np.ndarray, prefix: np.ndarray, spans: np.ndarray, scale: float, guard_x: int, guard_y: int) -> None:
    """Fill out (h, w, C) with the mean over the pupil's picture, `scale` px for a unit, of planes given by their sums along x.

    prefix: (h + 2 guard_y, w + 2 guard_x + 2, C), prefix[y, x] the sum of all pixels left of x.
    spans: (S, 5) v, from u, to u, weight, height of strips of the unit pupil; a negative scale turns it by 180 degrees.
    What lies at x0 is thrown to x0 + scale u, so the light of a pixel is read around x - scale u.
    """
    out[:] = 0.0
    for k in range(len(spans)):
        half = 0.5 * abs(scale) * spans[k, 4]
        above, below = 0.5 - scale * spans[k, 0] - half, 0.5 - scale * spans[k, 0] + half
        row = int(math.floor(above))
        while row < below:
            share = (min(below, row + 1.0) - max(above, float(row))) / (below - above)
            if share > 1e-6:
                add_strip(out, prefix, -scale * spans[k, 1], -scale * spans[k, 2], share * spans[k, 3], row, guard_x, guard_y)
            row += 1


@njit(cache=True, nogil=True)
def add_strip(out: np.ndarray, prefix: np.ndarray, one: float, other: float, weight: float, row: int, guard_x: int, guard_y: int) -> None:
    """Add weight times the mean between x + one and x + other, so many rows below."""
    height, width, channels = out.shape
    gain = np.float32(weight / abs(other - one))
    start, end = guard_x + 0.5 + min(one, other), guard_x + 0.5 + max(one, other)
    start_px, end_px = int(math.floor(start)), int(math.floor(end))
    s, e = np.float32(start - start_px), np.float32(end - end_px)
    length = width * channels
    for y in range(height):
        # Rows as one run of numbers, pixel by pixel: all channels of a row in one loop that the compiler makes vectors of.
        line, to = prefix[y + guard_y + row].ravel(), out[y].ravel()
        left, left_on = line[start_px * channels :][:length], line[(start_px + 1) * channels :][:length]
        right, right_on = line[end_px * channels :][:length], line[(end_px + 1) * channels :][:length]
        for k in range(length):
            to[k] += gain * ((right[k] + e * (right_on[k] - right[k])) - (left[k] + s * (left_on[k] - left[k])))


@njit(cache=True, nogil=True)
def sums_along_x(planes: np.ndarray) -> np.ndarray:
    """prefix[y, x]: the sum of planes[y, :x], one longer than the row and once more repeated for reading beyond."""
    height, width, channels = planes.shape
    prefix = np.zeros((height, width + 2, channels), np.float32)
    carried = np.zeros(channels)
    for y in range(height):
        carried[:] = 0.0
        for x in range(width):
            for c in range(channels):
                carried[c] += planes[y, x, c]
                prefix[y, x + 1, c] = carried[c]
        for c in range(channels):
            prefix[y, width + 1, c] = carried[c]
    return prefix


@njit(cache=True, nogil=True)
def line_taps(length_x: float, length_y: float) -> tuple[np.ndarray, np.ndarray]:
    """Offsets (T, 2) and weights of the pixels that a segment centred on a pixel crosses, by the length within each."""
    reach_x, reach_y = int(math.ceil(0.5 * abs(length_x))), int(math.ceil(0.5 * abs(length_y)))
    kernel = np.zeros((2 * reach_y + 1, 2 * reach_x + 1))
    cuts = np.empty(2 * (reach_x + reach_y) + 2)
    cuts[0], cuts[1] = -0.5, 0.5
    count = 2
    for length, reach in ((length_x, reach_x), (length_y, reach_y)):
        for k in range(reach):
            at = (k + 0.5) / abs(length)
            if at < 0.5:
                cuts[count], cuts[count + 1] = -at, at
                count += 2
    cuts = np.sort(cuts[:count])
    for k in range(count - 1):
        middle = 0.5 * (cuts[k] + cuts[k + 1])
        x, y = int(math.floor(middle * length_x + 0.5)), int(math.floor(middle * length_y + 0.5))
        kernel[y + reach_y, x + reach_x] += cuts[k + 1] - cuts[k]
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
    for k in range(len(weights)):
        weight = weights[k]
        first = (guard_x + offsets[k, 0]) * channels
        for y in range(height):
            line, to = planes[y + guard_y + offsets[k, 1]].ravel()[first:], out[y].ravel()
            for n in range(width * channels):
                to[n] += weight * line[n]


@njit(cache=True, nogil=True)
def smooth(planes: np.ndarray, variance_px2: float) -> None:
    """An even Gaussian in place, beyond the border nothing; what the spatial filter has beyond a pixel."""
    if variance_px2 < 0.04:
        return
    reach = int(math.ceil(3.0 * math.sqrt(variance_px2)))
    taps = np.exp(-0.5 * np.arange(-reach, reach + 1) ** 2 / variance_px2).astype(np.float32)
    taps /= taps.sum()
    height, width, channels = planes.shape
    across = np.zeros_like(planes)
    for y in range(height):
        for x in range(width):
            for k in range(max(-reach, -x), min(reach, width - 1 - x) + 1):
                for c in range(channels):
                    across[y, x, c] += taps[k + reach] * planes[y, x + k, c]
    planes[:] = 0.0
    for y in range(height):
        for k in range(max(-reach, -y), min(reach, height - 1 - y) + 1):
            for x in range(width):
                for c in range(channels):
                    planes[y, x, c] += taps[k + reach] * across[y + k, x, c]


@njit(cache=True, nogil=True)
def window_guards(scale: float, pupil_radius: float, length_x: float, length_y: float, variance_px2: float) -> tuple[int, int, int, int]:
    """Guard bands of the segment (x, y), of the pupil and of the spatial filter, in pixels."""
    pupil = int(math.ceil(abs(scale) * pupil_radius)) + 1
    around = int(math.ceil(3.0 * math.sqrt(variance_px2))) if variance_px2 >= 0.04 else 0
    return int(math.ceil(0.5 * abs(length_x))), int(math.ceil(0.5 * abs(length_y))), pupil, around


@njit(cache=True, nogil=True)
def window_filter(
    out: np.ndarray,
    planes: np.ndarray,
    spans: np.ndarray,
    scale: float,
    length_x: float,
    length_y: float,
    variance_px2: float,
    guards: tuple,
) -> None:
    """Pupil, then shutter: planes have guards[0..1] + guards[2] + guards[3] around out (h, w, C). Uses planes up."""
    line_x, line_y, pupil, around = guards
    smooth(planes, variance_px2)
    height, width, channels = out.shape
    inner = np.ascontiguousarray(planes[around : planes.shape[0] - around, around : planes.shape[1] - around])
    offsets, weights = line_taps(length_x, length_y)
    if abs(scale) < 0.1:
        along_line(out, inner, offsets, weights, line_x + pupil, line_y + pupil)
        return
    blurred = np.empty((height + 2 * line_y, width + 2 * line_x, channels), np.float32)
    add_spans(blurred, sums_along_x(inner), spans, scale, pupil, pupil)
    along_line(out, blurred, offsets, weights, line_x, line_y)
