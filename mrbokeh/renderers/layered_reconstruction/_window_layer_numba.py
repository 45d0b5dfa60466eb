"""One partition of a tile in the shapes of pupil and shutter, laid behind the others for each part of both on its own.

Whether a partition hides another depends on the place in the pupil and on the time. Within a part of both it is as good as even.
"""

import math

import numpy as np

from mrbokeh.renderers.layered_reconstruction._compositing_numba import composite
from mrbokeh.renderers.layered_reconstruction._filter_numba import PIXEL_VARIANCE, sheared_slopes
from mrbokeh.renderers.layered_reconstruction._reprojection_numba import evened_out, reproject
from mrbokeh.renderers.layered_reconstruction._segment_numba import along_line, line_taps
from mrbokeh.renderers.layered_reconstruction._tile_data import Choice, Light, Partitions, Pupil, Slope, WindowLayer
from mrbokeh.renderers.layered_reconstruction._window_numba import (
    LEAST_SCALE_PX,
    STRIPS_FOR_PX,
    pupil_filter,
    smooth,
    sums_along_x,
    window_guards,
)
from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True)
def window_layer(left: int, top: int, shape: tuple, j: int, partitions: Partitions, light: Light, choice: Choice) -> WindowLayer:
    """The partition j around the tile whose corner is (left, top), reprojected; shape: height, width and channels of the tile.

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
    """The strips of a cell that do for a pupil of this radius in pixels."""
    cells = len(pupil.shares)
    drawings = (len(pupil.starts) - 1) // (2 * cells)
    k = 0
    while k < drawings - 1 and abs(scale) > STRIPS_FOR_PX * (1 << k):
        k += 1
    k += drawings if scale > 0.0 else 0
    return pupil.spans[pupil.starts[k * cells + cell] : pupil.starts[k * cells + cell + 1]]
