"""One tile after the other: reprojection, screen-space filter and compositing of its partitions, front to back."""

import math

import numpy as np
from numba import njit

from mrbokeh.renderers.layered_reconstruction._direct_gaussian_numba import direct_gaussian
from mrbokeh.renderers.layered_reconstruction._filter_numba import axes, sheared_filter, sheared_slopes
from mrbokeh.renderers.layered_reconstruction._reprojection_numba import even_out, reproject
from mrbokeh.renderers.layered_reconstruction._sheared_gaussian_numba import sheared_gaussian
from mrbokeh.renderers.layered_reconstruction._texture_gaussian_numba import texture_gaussian
from mrbokeh.renderers.layered_reconstruction._window_numba import window_filter, window_guards

DIRECT, SHEARED, TEXTURE, TEXTURE_ONE_TAP, WINDOWS = 0, 1, 2, 3, 4
PIXEL_VARIANCE = 1.0 / 12.0
"""What a pixel as a bin adds to the spread of the samples in it: the variance of a box of 1 px."""

STRIPS_FOR_PX = 2.0
"""Up to this radius the coarsest drawing of the pupil does, up to twice of it the next."""

_LEAST_VARIANCE = 1e-4


@njit(cache=True, nogil=True)
def filter_layer(
    out: np.ndarray, planes: np.ndarray, guard_x: int, guard_y: int, v: tuple[float, float, float], how: np.ndarray, kind: int
) -> None:
    """how: (support, passes, alpha, tap distance, enough)."""
    if guard_x == 0 and guard_y == 0:
        out[:] = planes
    elif kind == SHEARED:
        sheared_gaussian(out, planes, guard_x, guard_y, v[0], v[1], v[2], int(how[1]))
    elif kind == DIRECT:
        direct_gaussian(out, planes, guard_x, guard_y, v[0], v[1], v[2])
    else:
        sigma_u, sigma_v, theta = axes(v[0], v[1], v[2])
        texture_gaussian(out, planes, guard_x, guard_y, sigma_u, sigma_v, theta, how[2], how[3], 4 if kind == TEXTURE else 1)


@njit(cache=True, nogil=True)
def guard_px(variance: float, support: float) -> int:
    """Pixels around a tile that its filter needs; a Gaussian that ends within its pixel needs none."""
    return int(math.ceil(support * math.sqrt(variance))) if variance > 0.04 else 0


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
def gaussian_layer(
    layer: np.ndarray,
    left: int,
    top: int,
    sums: np.ndarray,
    span: np.ndarray,
    light: tuple,
    window: np.ndarray,
    pupil_radius: float,
    sigma_x_px: float,
    bandwidth: float,
    how: np.ndarray,
    kind: int,
) -> None:
    """Fill layer (h, w, C + 2), whose top left pixel is (left, top), with the filtered colour, opacity and weight of a partition."""
    height, width, channels = layer.shape
    a, b_x, b_y, v_xx, v_xy, v_yy = sheared_filter(sums, window, sigma_x_px, bandwidth)
    v_xx, v_yy = max(v_xx - PIXEL_VARIANCE, _LEAST_VARIANCE), max(v_yy - PIXEL_VARIANCE, _LEAST_VARIANCE)
    guard_x, guard_y = guard_px(v_xx, how[0]), guard_px(v_yy, how[0])
    planes = np.zeros((height + 2 * guard_y, width + 2 * guard_x, channels), np.float32)
    reproject(planes, left - guard_x, top - guard_y, pupil_radius, (a, b_x, b_y), span, light)
    even_out(planes, how[4])
    filter_layer(layer, planes, guard_x, guard_y, (v_xx, v_xy, v_yy), how, kind)


@njit(cache=True, nogil=True)
def window_layer(
    layer: np.ndarray,
    left: int,
    top: int,
    sums: np.ndarray,
    span: np.ndarray,
    light: tuple,
    window: np.ndarray,
    pupil_radius: float,
    sigma_x_px: float,
    bandwidth: float,
    how: np.ndarray,
    pupil: np.ndarray,
    pupil_starts: np.ndarray,
) -> None:
    """The same with the shapes of pupil and shutter, scaled to the variance that the shear leaves."""
    height, width, channels = layer.shape
    r, m_x, m_y, kappa_u, kappa_t = sheared_slopes(sums, window, sigma_x_px, bandwidth)
    scale, share = r * math.sqrt(kappa_u * (2.0 - kappa_u)), math.sqrt(kappa_t * (2.0 - kappa_t))
    rest = sigma_x_px**2 - PIXEL_VARIANCE
    guards = window_guards(scale, pupil_radius, share * m_x, share * m_y, rest)
    guard_x, guard_y = guards[0] + guards[2] + guards[3], guards[1] + guards[2] + guards[3]
    planes = np.zeros((height + 2 * guard_y, width + 2 * guard_x, channels), np.float32)
    reproject(planes, left - guard_x, top - guard_y, pupil_radius, (kappa_u * r, kappa_t * m_x, kappa_t * m_y), span, light)
    even_out(planes, how[4])
    drawings = (len(pupil_starts) - 1) // 2
    drawing = 0
    while drawing < drawings - 1 and abs(scale) > STRIPS_FOR_PX * (1 << drawing):
        drawing += 1
    drawing += drawings if scale > 0.0 else 0
    strips = pupil[pupil_starts[drawing] : pupil_starts[drawing + 1]]
    window_filter(layer, planes, strips, scale, share * m_x, share * m_y, rest, guards)


@njit(cache=True, nogil=True)
def reconstruct_tile(
    out: np.ndarray,
    tile: int,
    columns: int,
    tile_px: int,
    partitions: np.ndarray,
    spans: np.ndarray,
    count: int,
    geometry: np.ndarray,
    values: np.ndarray,
    bucket: np.ndarray,
    starts: np.ndarray,
    window: np.ndarray,
    pupil_radius: float,
    sigma_x_px: float,
    bandwidth: float,
    how: np.ndarray,
    kind: int,
    pupil: np.ndarray,
    pupil_starts: np.ndarray,
) -> None:
    """Fill the tile's pixels of out (H, W, C)."""
    left, top = (tile % columns) * tile_px, (tile // columns) * tile_px
    picture = out[top : top + tile_px, left : left + tile_px]
    height, width, channels = picture.shape
    seen_past = np.ones((height, width), np.float32)
    layer = np.empty((height, width, channels + 2), np.float32)
    picture[:] = 0.0
    light = (geometry, values, bucket, starts, columns, tile_px)
    for j in range(count):
        if kind == WINDOWS:
            window_layer(
                layer, left, top, partitions[j], spans[j], light, window, pupil_radius, sigma_x_px, bandwidth, how, pupil, pupil_starts
            )
        else:
            gaussian_layer(layer, left, top, partitions[j], spans[j], light, window, pupil_radius, sigma_x_px, bandwidth, how, kind)
        composite(picture, seen_past, layer)
    share_out(picture, seen_past)
    own_means(picture, seen_past, left, top, starts[tile], starts[tile + 1], geometry, values)


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
