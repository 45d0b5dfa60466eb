"""One tile after the other: reprojection, screen-space filter and compositing of its partitions, front to back."""

import math

import numpy as np
from numba import njit

from mrbokeh.renderers.layered_reconstruction._compositing_numba import composite, own_means, share_out
from mrbokeh.renderers.layered_reconstruction._direct_gaussian_numba import direct_gaussian
from mrbokeh.renderers.layered_reconstruction._filter_numba import axes, sheared_filter, sheared_slopes
from mrbokeh.renderers.layered_reconstruction._partitions_numba import partitions_of_tile
from mrbokeh.renderers.layered_reconstruction._reprojection_numba import evened_out, reproject
from mrbokeh.renderers.layered_reconstruction._sheared_gaussian_numba import sheared_gaussian
from mrbokeh.renderers.layered_reconstruction._texture_gaussian_numba import texture_gaussian
from mrbokeh.renderers.layered_reconstruction._tile_data import Choice, Light, Partitions, Pupil, Slope
from mrbokeh.renderers.layered_reconstruction._window_numba import window_filter, window_guards

DIRECT, SHEARED, TEXTURE, TEXTURE_ONE_TAP, WINDOWS = 0, 1, 2, 3, 4
PIXEL_VARIANCE = 1.0 / 12.0
"""What a pixel as a bin adds to the spread of the samples in it: the variance of a box of 1 px."""

STRIPS_FOR_PX = 2.0
"""Up to this radius the coarsest drawing of the pupil does, up to twice of it the next."""

_LEAST_VARIANCE = 1e-4


@njit(cache=True, nogil=True)
def filter_layer(out: np.ndarray, planes: np.ndarray, guard_x: int, guard_y: int, v: tuple[float, float, float], choice: Choice) -> None:
    kind = choice.kind
    if guard_x == 0 and guard_y == 0:
        out[:] = planes
    elif kind == SHEARED:
        sheared_gaussian(out, planes, guard_x, guard_y, v[0], v[1], v[2], choice.passes)
    elif kind == DIRECT:
        direct_gaussian(out, planes, guard_x, guard_y, v[0], v[1], v[2])
    else:
        sigma_u, sigma_v, theta = axes(v[0], v[1], v[2])
        texture_gaussian(
            out, planes, guard_x, guard_y, sigma_u, sigma_v, theta, choice.alpha, choice.tap_distance, 4 if kind == TEXTURE else 1
        )


@njit(cache=True, nogil=True)
def guard_px(variance: float, support: float) -> int:
    """Pixels around a tile that its filter needs; a Gaussian that ends within its pixel needs none."""
    return int(math.ceil(support * math.sqrt(variance))) if variance > 0.04 else 0


@njit(cache=True, nogil=True)
def gaussian_layer(layer: np.ndarray, left: int, top: int, j: int, partitions: Partitions, light: Light, choice: Choice) -> None:
    """Fill layer (h, w, C + 2), whose top left pixel is (left, top), with the filtered colour, opacity and weight of a partition."""
    height, width, channels = layer.shape
    a, b_x, b_y, v_xx, v_xy, v_yy = sheared_filter(partitions.sums[j], light.window, choice.sigma_x_px, choice.bandwidth)
    v_xx, v_yy = max(v_xx - PIXEL_VARIANCE, _LEAST_VARIANCE), max(v_yy - PIXEL_VARIANCE, _LEAST_VARIANCE)
    guard_x, guard_y = guard_px(v_xx, choice.support), guard_px(v_yy, choice.support)
    planes = np.zeros((height + 2 * guard_y, width + 2 * guard_x, channels + 1), np.float32)
    reproject(planes, left - guard_x, top - guard_y, Slope(a, b_x, b_y), j, partitions, light, choice.shared_out)
    planes = evened_out(planes, choice.enough)
    filter_layer(layer, planes, guard_x, guard_y, (v_xx, v_xy, v_yy), choice)


@njit(cache=True, nogil=True)
def window_layer(
    layer: np.ndarray, left: int, top: int, j: int, partitions: Partitions, light: Light, choice: Choice, pupil: Pupil
) -> None:
    """The same with the shapes of pupil and shutter, scaled to the variance that the shear leaves."""
    height, width, channels = layer.shape
    r, m_x, m_y, kappa_u, kappa_t = sheared_slopes(partitions.sums[j], light.window, choice.sigma_x_px, choice.bandwidth)
    scale, share = r * math.sqrt(kappa_u * (2.0 - kappa_u)), math.sqrt(kappa_t * (2.0 - kappa_t))
    rest = choice.sigma_x_px**2 - PIXEL_VARIANCE
    guards = window_guards(scale, light.pupil_radius, share * m_x, share * m_y, rest)
    guard_x, guard_y = guards[0] + guards[2] + guards[3], guards[1] + guards[2] + guards[3]
    planes = np.zeros((height + 2 * guard_y, width + 2 * guard_x, channels + 1), np.float32)
    reproject(
        planes, left - guard_x, top - guard_y, Slope(kappa_u * r, kappa_t * m_x, kappa_t * m_y), j, partitions, light, choice.shared_out
    )
    planes = evened_out(planes, choice.enough)
    window_filter(layer, planes, drawing(pupil, scale), scale, share * m_x, share * m_y, rest, guards)


@njit(cache=True, nogil=True)
def drawing(pupil: Pupil, scale: float) -> np.ndarray:
    """The strips that do for a pupil of this radius in pixels."""
    drawings = (len(pupil.starts) - 1) // 2
    k = 0
    while k < drawings - 1 and abs(scale) > STRIPS_FOR_PX * (1 << k):
        k += 1
    k += drawings if scale > 0.0 else 0
    return pupil.spans[pupil.starts[k] : pupil.starts[k + 1]]


@njit(cache=True, nogil=True)
def reconstruct_tiles(
    out: np.ndarray, tiles: np.ndarray, counts: np.ndarray, light: Light, choice: Choice, pupil: Pupil, buckets: int
) -> None:
    """Fill the pixels of these tiles of out (H, W, C), and counts (T, 2) of populated buckets and partitions."""
    place = np.full(buckets, -1, np.int32)
    for tile in tiles:
        partitions, touched, populated = partitions_of_tile(tile, light, choice, place)
        counts[tile, 0], counts[tile, 1] = populated, len(partitions.sums)
        reconstruct_tile(out, tile, partitions, light, choice, pupil)
        for bucket in touched:
            place[bucket] = -1


@njit(cache=True, nogil=True)
def reconstruct_tile(out: np.ndarray, tile: int, partitions: Partitions, light: Light, choice: Choice, pupil: Pupil) -> None:
    tile_px = light.tile_px
    left, top = (tile % light.columns) * tile_px, (tile // light.columns) * tile_px
    picture = out[top : top + tile_px, left : left + tile_px]
    height, width, channels = picture.shape
    seen_past = np.ones((height, width), np.float32)
    layer = np.empty((height, width, channels + 2), np.float32)
    picture[:] = 0.0
    for j in range(len(partitions.sums)):
        if choice.kind == WINDOWS:
            window_layer(layer, left, top, j, partitions, light, choice, pupil)
        else:
            gaussian_layer(layer, left, top, j, partitions, light, choice)
        composite(picture, seen_past, layer)
    share_out(picture, seen_past)
    own_means(picture, seen_past, left, top, light.starts[tile * 16], light.starts[tile * 16 + 16], light.geometry, light.values)
