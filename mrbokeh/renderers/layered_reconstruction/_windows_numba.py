"""Compiled filter of a partition in the true shapes of pupil and shutter, laid behind the others for each part of both on its own.

The pupil's picture stands in place of the Gaussian, and the shutter's segment, or a stretch of it, along which a partition moves. Whether
a partition hides another depends on the place in the pupil and on the time. Within a part of both it is as good as even.
"""

import math

import numpy as np

from mrbokeh.renderers.layered_reconstruction._filter_numba import PIXEL_VARIANCE, evened_out, reproject, sheared_slopes
from mrbokeh.renderers.layered_reconstruction._tile_data import Choice, Light, Partitions, Pupil, Slope, WindowLayer
from mrbokeh.system.compiled import njit

STRIPS_FOR_PX = 2.0
"""Up to this radius the coarsest drawing of the pupil does, up to twice of it the next."""
LEAST_SCALE_PX = 0.1
"""A pupil of a smaller radius is a point."""


@njit(cache=True, nogil=True)
def window_layer(left: int, top: int, shape: tuple, j: int, partitions: Partitions, light: Light, choice: Choice) -> WindowLayer:
    """Return the partition j around the tile whose corner is (left, top), reprojected; shape: height, width and channels of the tile.

    The shapes of pupil and shutter are scaled to the variance that the shear leaves.
    """
    r, m_x, m_y, kappa_u, kappa_t = sheared_slopes(partitions.sums[j], light.window, choice.sigma_x_px, choice.bandwidth)
    scale, share = r * math.sqrt(kappa_u * (2.0 - kappa_u)), math.sqrt(kappa_t * (2.0 - kappa_t))
    rest = choice.sigma_x_px**2 - PIXEL_VARIANCE
    guard_x, guard_y, guard, around = window_guards(scale, light.pupil_radius, share * m_x, share * m_y, rest)
    beyond_x, beyond_y = guard_x + guard + around, guard_y + guard + around
    planes = np.zeros((shape[0] + 2 * beyond_y, shape[1] + 2 * beyond_x, shape[2] + 3), np.float32)
    slope = Slope(kappa_u * r, kappa_t * m_x, kappa_t * m_y)
    reproject(planes, left - beyond_x, top - beyond_y, slope, j, partitions, light, choice.shared_out)
    planes = evened_out(planes, choice.enough)
    smooth(planes, rest)
    if around > 0:
        planes = np.ascontiguousarray(planes[around : planes.shape[0] - around, around : planes.shape[1] - around])
    return WindowLayer(planes, scale, share * m_x, share * m_y, guard_x, guard_y, guard)


@njit(cache=True, nogil=True)
def lay_parts(pictures: np.ndarray, seen_past: np.ndarray, one: WindowLayer, pupil: Pupil) -> None:
    """Lay a partition behind what pictures (cells, times, h, w, C) hold; seen_past: (cells, times, h, w).

    What moves by less than a pixel is the same at all times, and what is in focus through all of the pupil.
    """
    cells, times, height, width, channels = pictures.shape
    layer = np.empty((height, width, channels + 2), np.float32)
    blurred = np.empty((height + 2 * one.guard_y, width + 2 * one.guard_x, channels + 2), np.float32)
    prefix = sums_along_x(one.planes)
    is_point, is_still = abs(one.scale) < LEAST_SCALE_PX, abs(one.length_x) < 1.0 and abs(one.length_y) < 1.0
    # What lies at x0 is carried to x0 + length t, so the light of a pixel is read around x - length t.
    lines = [line_taps(-one.length_x, -one.length_y, time / times - 0.5, (time + 1) / times - 0.5) for time in range(times)]
    for cell in range(cells):
        if cell == 0 or not is_point:
            pupil_filter(blurred, one.planes, prefix, drawing(pupil, one.scale, cell), one.scale, one.guard)
        for time in range(times):
            if (time == 0 or not is_still) and not (is_point and is_still and cell > 0):
                offsets, weights = lines[time]
                along_line(layer, blurred, offsets, weights, one.guard_x, one.guard_y)
            composite(pictures[cell, time], seen_past[cell, time], layer)


@njit(cache=True, nogil=True)
def drawing(pupil: Pupil, scale: float, cell: int) -> np.ndarray:
    """Return the strips of a cell that do for a pupil of this radius in pixels."""
    cells = len(pupil.shares)
    drawings = (len(pupil.starts) - 1) // (2 * cells)
    k = 0
    while k < drawings - 1 and abs(scale) > STRIPS_FOR_PX * (1 << k):
        k += 1
    k += drawings if scale > 0.0 else 0
    return pupil.spans[pupil.starts[k * cells + cell] : pupil.starts[k * cells + cell + 1]]


@njit(cache=True, nogil=True)
def line_taps(length_x: float, length_y: float, begin: float, end: float) -> tuple[np.ndarray, np.ndarray]:
    """Return offsets (T, 2) and weights, sum 1, of the pixels that a segment centred on a pixel crosses from `begin` to `end`, both from
    -1/2 to 1/2 of its length, by the length within each.
    """
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
    """Return prefix[y, x]: the sum of planes[y, :x], one longer than the row and once more repeated for reading beyond."""
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
    """Smooth by an even Gaussian in place, with nothing beyond the border: what the spatial filter has beyond a pixel."""
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
    """Return guard bands of the segment (x, y), of the pupil and of the spatial filter, in pixels."""
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
    """Divide what no layer claims among the layers that were seen: behind the last layer nothing was sampled."""
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
    """Show in a pixel that no layer reaches the mean of its own samples."""
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
