"""Compiled reprojection and filter formulas of layered reconstruction; docs/methods/layered_reconstruction.md derives every line.

Samples go tile by tile, within a tile by pixels in Morton order. The sheared filter of a partition comes from the sums over its
samples, and the samples around a tile are reprojected along the partition's slopes (Eq. 1).
"""

import math

import numpy as np

from mrbokeh.renderers.layered_reconstruction._tile_data import BLOCKS, BLOCKS_ACROSS, Light, Partitions, Slope
from mrbokeh.system.compiled import njit


@njit(cache=True, nogil=True)
def morton(x: int, y: int) -> int:
    """Return the bits of x and y interleaved, x first: neighbours in the plane stay neighbours on the line."""
    code = 0
    for bit in range(8):
        code |= ((x >> bit) & 1) << (2 * bit)
        code |= ((y >> bit) & 1) << (2 * bit + 1)
    return code


@njit(cache=True, nogil=True)
def tile_order(xy_px: np.ndarray, width_px: int, height_px: int, tile_px: int, order: np.ndarray, starts: np.ndarray) -> None:
    """Fill order (N,) with the indices of the samples and starts (tiles + 1,) with where each tile begins; stable.

    tile_px: a power of two, at most 256.
    """
    columns, rows = -(-width_px // tile_px), -(-height_px // tile_px)
    per_tile = tile_px * tile_px
    ends = np.zeros(columns * rows * per_tile + 1, np.int64)
    keys = np.empty(len(xy_px), np.int64)
    for i in range(len(xy_px)):
        x, y = min(int(xy_px[i, 0]), width_px - 1), min(int(xy_px[i, 1]), height_px - 1)
        tile = (y // tile_px) * columns + x // tile_px
        keys[i] = tile * per_tile + morton(x % tile_px, y % tile_px)
        ends[keys[i] + 1] += 1
    for key in range(len(ends) - 1):
        ends[key + 1] += ends[key]
    for block in range(len(starts)):
        starts[block] = ends[block * (per_tile // BLOCKS)]
    for i in range(len(keys)):
        order[ends[keys[i]]] = i
        ends[keys[i]] += 1


BESIDE_DEPTHS = 16
"""Up to so many depth buckets in front of a partition may belong to the same slanted surface."""

_SHARP_PX = 0.5


@njit(cache=True, nogil=True)
def reproject(
    planes: np.ndarray, left: int, top: int, slope: Slope, j: int, partitions: Partitions, light: Light, shared_out: bool
) -> None:
    """Add to planes (h, w, C + 3), whose top left pixel is (left, top), colour, opacity, weight and count of the partition j.

    A sample of the partition adds its values and an opacity, a weight and a count of 1. One behind adds a weight and a
    count: it was seen through this place. One just in front adds a count alone, one far in front nothing.
    """
    height, width, _ = planes.shape
    reach_x = abs(slope.a) * light.pupil_radius + 0.5 * abs(slope.b_x)
    reach_y = abs(slope.a) * light.pupil_radius + 0.5 * abs(slope.b_y)
    sharp = not shared_out or (reach_x < _SHARP_PX and reach_y < _SHARP_PX)
    side_px = light.tile_px // BLOCKS_ACROSS
    rows = (len(light.starts) - 1) // BLOCKS // light.columns
    first_x, last_x = block_range(left, width, reach_x, side_px, light.columns * BLOCKS_ACROSS)
    first_y, last_y = block_range(top, height, reach_y, side_px, rows * BLOCKS_ACROSS)
    for y in range(first_y, last_y + 1):
        for x in range(first_x, last_x + 1):
            tile = (y // BLOCKS_ACROSS) * light.columns + x // BLOCKS_ACROSS
            block = tile * BLOCKS + morton(x % BLOCKS_ACROSS, y % BLOCKS_ACROSS)
            add_block(planes, left, top, light.starts[block], light.starts[block + 1], sharp, slope, j, partitions, light)


@njit(cache=True, nogil=True)
def block_range(from_px: int, size_px: int, reach_px: float, side_px: int, count: int) -> tuple[int, int]:
    """Return the first and last block whose samples may land on the pixels from from_px on."""
    first, last = int(math.floor((from_px - reach_px) / side_px)), int(math.floor((from_px + size_px + reach_px) / side_px))
    return max(0, first), min(count - 1, last)


@njit(cache=True, nogil=True)
def add_block(
    planes: np.ndarray, left: int, top: int, first: int, end: int, sharp: bool, slope: Slope, j: int, partitions: Partitions, light: Light
) -> None:
    """Add the samples from first to end. sharp: each counts for the pixel it is in; else it is shared out among the four nearest."""
    height, width, channels = planes.shape
    flat, across, step_x, zero = planes.reshape(-1), np.uint64(width * channels), np.uint64(channels), np.uint64(0)
    to_opacity, to_weight, to_count = np.uint64(channels - 3), np.uint64(channels - 2), np.uint64(channels - 1)
    a, b_x, b_y = np.float32(slope.a), np.float32(slope.b_x), np.float32(slope.b_y)
    off_x, off_y = np.float32(left), np.float32(top)
    if not sharp:
        off_x, off_y, width, height = off_x + np.float32(0.5), off_y + np.float32(0.5), width - 1, height - 1
    own, before = 2 * j, (partitions.first[j] - BESIDE_DEPTHS) * light.cells
    geometry, buckets, values = light.geometry[first:end], light.bucket[first:end], light.values[first:end]
    for i in range(end - first):
        if buckets[i] < before:
            continue
        x = geometry[i, 0] - a * geometry[i, 2] - b_x * geometry[i, 4] - off_x
        y = geometry[i, 1] - a * geometry[i, 3] - b_y * geometry[i, 4] - off_y
        if not (np.float32(0.0) <= x < width and np.float32(0.0) <= y < height):
            continue
        bucket = np.uint64(buckets[i])
        at = partitions.place[bucket]
        if at < 0:
            at = partitions.gaps[bucket // np.uint64(light.cells)]
        column, row = int(x), int(y)
        # Without signs the compiler has no negative indices to look for, which would take it as long as all the rest.
        place = np.uint64(row) * across + np.uint64(column * channels)
        right, below, taps = np.float32(0.0), np.float32(0.0), 1
        if not sharp:
            right, below, taps = x - np.float32(column), y - np.float32(row), 4
        one, other = np.float32(1.0) - right, np.float32(1.0) - below
        if at < own:
            for tap in range(taps):
                share = (right if tap & 1 else one) * (below if tap >> 1 else other)
                flat[place + (step_x if tap & 1 else zero) + (across if tap >> 1 else zero) + to_count] += share
        else:
            for tap in range(taps):
                share = (right if tap & 1 else one) * (below if tap >> 1 else other)
                to = place + (step_x if tap & 1 else zero) + (across if tap >> 1 else zero)
                flat[to + to_count] += share
                flat[to + to_weight] += share
                if at == own:
                    for c in range(channels - 3):
                        flat[to + np.uint64(c)] += share * values[i, c]
                    flat[to + to_opacity] += share


@njit(cache=True, nogil=True)
def evened_out(planes: np.ndarray, enough: float) -> np.ndarray:
    """Return planes (h, w, C + 2) without the count, in which no place weighs more than `enough` samples do, its colour and opacity in
    proportion.

    Samples fall on places in uneven numbers by chance. Left so, that chance is noise in every mean over places.
    """
    height, width, channels = planes.shape
    channels -= 1
    even = np.empty((height, width, channels), np.float32)
    for y in range(height):
        for x in range(width):
            count = planes[y, x, channels]
            share = np.float32(enough) / count if count > enough else np.float32(1.0)
            for c in range(channels):
                even[y, x, c] = share * planes[y, x, c]
    return even


SUMS = 8
"""Columns of a row of sums: count, r, r^2, m_x, m_y, m_x^2, m_x m_y, m_y^2, with r half the signed circle of confusion."""

PIXEL_VARIANCE = 1.0 / 12.0
"""What a pixel as a bin adds to the spread of the samples in it: the variance of a box of 1 px."""


@njit(cache=True, nogil=True)
def sheared_slopes(sums: np.ndarray, window: np.ndarray, sigma_x_px: float, bandwidth: float) -> tuple[float, float, float, float, float]:
    """Return (r, m_x, m_y, kappa_u, kappa_t): the mean slopes of a partition and the shares of them that the filter is sheared
    by.
    """
    n = sums[0]
    r, m_x, m_y = sums[1] / n, sums[3] / n, sums[4] / n
    var_r = max(sums[2] / n - r * r, 0.0)
    var_xx, var_xy, var_yy = max(sums[5] / n - m_x * m_x, 0.0), sums[6] / n - m_x * m_y, max(sums[7] / n - m_y * m_y, 0.0)
    d_uu, d_uv, d_vv, d_tt = window[0], window[1], window[2], window[3]
    # The blur of the mean sample: what of the spectrum passes pupil, shutter and pixel.
    out_xx = sigma_x_px**2 + r * r * d_uu + d_tt * m_x * m_x
    out_xy = r * r * d_uv + d_tt * m_x * m_y
    out_yy = sigma_x_px**2 + r * r * d_vv + d_tt * m_y * m_y
    det = max(out_xx * out_yy - out_xy * out_xy, 1e-12)
    # How far the slopes of single samples leave the mean one, within that band: trace and determinant of V^-1 D.
    half = 0.5 * (out_yy * d_uu - 2.0 * out_xy * d_uv + out_xx * d_vv) / det
    largest = half + math.sqrt(max(half * half - (d_uu * d_vv - d_uv * d_uv) / det, 0.0))
    trace_m = (out_yy * var_xx - 2.0 * out_xy * var_xy + out_xx * var_yy) / det
    kappa_u = 1.0 / (1.0 + bandwidth**2 * var_r * largest)
    kappa_t = 1.0 / (1.0 + bandwidth**2 * d_tt * trace_m)
    return r, m_x, m_y, kappa_u, kappa_t


@njit(cache=True, nogil=True)
def sheared_filter(
    sums: np.ndarray, window: np.ndarray, sigma_x_px: float, bandwidth: float
) -> tuple[float, float, float, float, float, float]:
    """Return (a, b_x, b_y, V_xx, V_xy, V_yy): reprojection x' = x - a (u, v) - b (t - 1/2), then a Gaussian of covariance V."""
    r, m_x, m_y, kappa_u, kappa_t = sheared_slopes(sums, window, sigma_x_px, bandwidth)
    lens, shutter = kappa_u * (2.0 - kappa_u) * r * r, kappa_t * (2.0 - kappa_t) * window[3]
    v_xx = sigma_x_px**2 + lens * window[0] + shutter * m_x * m_x
    v_xy = lens * window[1] + shutter * m_x * m_y
    v_yy = sigma_x_px**2 + lens * window[2] + shutter * m_y * m_y
    return kappa_u * r, kappa_t * m_x, kappa_t * m_y, v_xx, v_xy, v_yy


@njit(cache=True, nogil=True)
def axes(v_xx: float, v_xy: float, v_yy: float) -> tuple[float, float, float]:
    """Return (sigma_u, sigma_v, theta) with sigma_u >= sigma_v and theta the angle of the u axis from x towards y."""
    middle, half = 0.5 * (v_xx + v_yy), math.hypot(0.5 * (v_xx - v_yy), v_xy)
    return math.sqrt(middle + half), math.sqrt(max(middle - half, 0.0)), 0.5 * math.atan2(2.0 * v_xy, v_xx - v_yy)


@njit(cache=True, nogil=True)
def sheared_axes(sigma_u: float, sigma_v: float, theta: float) -> tuple[float, float, float]:
    """Return (s_u, s_v, beta) of Eq. 9: the same Gaussian as one along x after one along (beta, 1)."""
    cosine, sine = math.cos(theta), math.sin(theta)
    rho = math.sqrt((sigma_v * cosine) ** 2 + (sigma_u * sine) ** 2)
    if rho == 0.0:
        return sigma_u, 0.0, 0.0
    return sigma_u * sigma_v / rho, rho, cosine * sine * (sigma_u**2 - sigma_v**2) / rho**2


@njit(cache=True, nogil=True)
def extents(sums: np.ndarray, window: np.ndarray, sigma_x_px: float, bandwidth: float) -> tuple[float, float]:
    """Return standard deviations of the screen-space filter along its axes, the longer first."""
    _, _, _, v_xx, v_xy, v_yy = sheared_filter(sums, window, sigma_x_px, bandwidth)
    sigma_u, sigma_v, _ = axes(v_xx, v_xy, v_yy)
    return sigma_u, sigma_v


@njit(cache=True, nogil=True)
def blur_px(sums: np.ndarray, window: np.ndarray, sigma_x_px: float) -> tuple[float, float]:
    """Return standard deviations of the blur of the mean sample along its axes, the longer first."""
    r, m_x, m_y = sums[1] / sums[0], sums[3] / sums[0], sums[4] / sums[0]
    out_xx = sigma_x_px**2 + r * r * window[0] + window[3] * m_x * m_x
    out_xy = r * r * window[1] + window[3] * m_x * m_y
    out_yy = sigma_x_px**2 + r * r * window[2] + window[3] * m_y * m_y
    sigma_u, sigma_v, _ = axes(out_xx, out_xy, out_yy)
    return sigma_u, sigma_v


@njit(cache=True, nogil=True)
def slope_distance(one: np.ndarray, other: np.ndarray, window: np.ndarray, sigma_x_px: float) -> float:
    """Return by how much reprojection along the mean slopes of the other goes wrong for the mean sample of one, in units of its own
    blur.
    """
    r, m_x, m_y = one[1] / one[0], one[3] / one[0], one[4] / one[0]
    off_r, off_x, off_y = other[1] / other[0] - r, other[3] / other[0] - m_x, other[4] / other[0] - m_y
    out_xx = sigma_x_px**2 + r * r * window[0] + window[3] * m_x * m_x
    out_xy = r * r * window[1] + window[3] * m_x * m_y
    out_yy = sigma_x_px**2 + r * r * window[2] + window[3] * m_y * m_y
    det = max(out_xx * out_yy - out_xy * out_xy, 1e-12)
    lens = off_r**2 * (out_yy * window[0] - 2.0 * out_xy * window[1] + out_xx * window[2]) / (2.0 * det)
    shutter = window[3] * (out_yy * off_x**2 - 2.0 * out_xy * off_x * off_y + out_xx * off_y**2) / det
    return math.sqrt(lens + shutter)
