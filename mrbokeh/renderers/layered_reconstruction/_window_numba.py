"""The true shape of the pupil over the screen, in place of the Gaussian that stands for it."""

import math

import numpy as np

from mrbokeh.system.kernels import njit

STRIPS_FOR_PX = 2.0
"""Up to this radius the coarsest drawing of the pupil does, up to twice of it the next."""

LEAST_SCALE_PX = 0.1
"""A pupil of a smaller radius is a point."""


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
    gain = weight / abs(other - one)
    start, end = guard_x + 0.5 + min(one, other), guard_x + 0.5 + max(one, other)
    start_px, end_px = int(math.floor(start)), int(math.floor(end))
    s, e = start - start_px, end - end_px
    # Rows as one run of numbers, pixel by pixel: all channels of a row in one loop that the compiler makes vectors of, which it does
    # for indices without a sign. Views of rows would take longer than what is done with short ones.
    from_flat, to_flat, step = prefix.reshape(-1), out.reshape(-1), np.uint64(channels)
    length, across = np.uint64(width * channels), np.uint64(prefix.shape[1] * channels)
    left, right = np.uint64(start_px * channels), np.uint64(end_px * channels)
    line = np.uint64(guard_y + row) * across
    to = np.uint64(0)
    for _ in range(height):
        for k in range(length):
            begin, stop = line + left + k, line + right + k
            before = from_flat[begin] + s * (from_flat[begin + step] - from_flat[begin])
            to_flat[to + k] += gain * ((from_flat[stop] + e * (from_flat[stop + step] - from_flat[stop])) - before)
        line, to = line + across, to + length


@njit(cache=True, nogil=True)
def sums_along_x(planes: np.ndarray) -> np.ndarray:
    """prefix[y, x]: the sum of planes[y, :x], one longer than the row and once more repeated for reading beyond."""
    height, width, channels = planes.shape
    prefix = np.zeros((height, width + 2, channels))
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
def pupil_filter(out: np.ndarray, planes: np.ndarray, prefix: np.ndarray, spans: np.ndarray, scale: float, guard: int) -> None:
    """Fill out (h, w, C) with the mean of planes (h + 2 guard, w + 2 guard, C), whose sums along x are prefix, over the pupil's picture
    or a cell of it."""
    if abs(scale) < LEAST_SCALE_PX:
        out[:] = planes[guard : planes.shape[0] - guard, guard : planes.shape[1] - guard]
    else:
        add_spans(out, prefix, spans, scale, guard, guard)
