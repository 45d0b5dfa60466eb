"""One partition of a tile by Gaussians over the screen, as in the papers."""

import math

import numpy as np

from mrbokeh.renderers.layered_reconstruction._direct_gaussian_numba import direct_gaussian
from mrbokeh.renderers.layered_reconstruction._filter_numba import PIXEL_VARIANCE, axes, sheared_filter
from mrbokeh.renderers.layered_reconstruction._reprojection_numba import evened_out, reproject
from mrbokeh.renderers.layered_reconstruction._sheared_gaussian_numba import sheared_gaussian
from mrbokeh.renderers.layered_reconstruction._texture_gaussian_numba import texture_gaussian
from mrbokeh.renderers.layered_reconstruction._tile_data import Choice, Light, Partitions, Slope
from mrbokeh.system.kernels import njit

DIRECT, SHEARED, TEXTURE, TEXTURE_ONE_TAP, WINDOWS = 0, 1, 2, 3, 4

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
