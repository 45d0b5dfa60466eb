"""One partition of a tile in the shapes of pupil and shutter, laid behind the others for each part of both on its own.

Whether a partition hides another depends on the place in the pupil and on the time. Within a part of both it is as good as even.
"""

import math

import numpy as np
from numba import njit

from mrbokeh.renderers.layered_reconstruction._compositing_numba import composite
from mrbokeh.renderers.layered_reconstruction._filter_numba import PIXEL_VARIANCE, sheared_slopes
from mrbokeh.renderers.layered_reconstruction._reprojection_numba import evened_out, reproject
from mrbokeh.renderers.layered_reconstruction._segment_numba import along_line, line_taps
from mrbokeh.renderers.layered_reconstruction._tile_data import Choice, Light, Partitions, Pupil, Slope
from mrbokeh.renderers.layered_reconstruction._window_numba import (
    LEAST_SCALE_PX,
    STRIPS_FOR_PX,
    pupil_filter,
    smooth,
    sums_along_x,
    window_guards,
)


@njit(cache=True, nogil=True)
def lay_windows(
    pictures: np.ndarray,
    seen_past: np.ndarray,
    left: int,
    top: int,
    j: int,
    partitions: Partitions,
    light: Light,
    choice: Choice,
    pupil: Pupil,
) -> None:
    """Lay the partition j behind what pictures (cells, times, h, w, C) hold; left, top: their corner in the whole picture.

    seen_past: (cells, times, h, w). The shapes are scaled to the variance that the shear leaves.
    """
    r, m_x, m_y, kappa_u, kappa_t = sheared_slopes(partitions.sums[j], light.window, choice.sigma_x_px, choice.bandwidth)
    scale, share = r * math.sqrt(kappa_u * (2.0 - kappa_u)), math.sqrt(kappa_t * (2.0 - kappa_t))
    rest = choice.sigma_x_px**2 - PIXEL_VARIANCE
    guards = window_guards(scale, light.pupil_radius, share * m_x, share * m_y, rest)
    slope = Slope(kappa_u * r, kappa_t * m_x, kappa_t * m_y)
    planes = window_planes(pictures.shape[2:], left, top, guards, rest, slope, j, partitions, light, choice)
    lay_parts(pictures, seen_past, planes, scale, share * m_x, share * m_y, guards, pupil)


@njit(cache=True, nogil=True)
def window_planes(
    shape: tuple,
    left: int,
    top: int,
    guards: tuple,
    rest: float,
    slope: Slope,
    j: int,
    partitions: Partitions,
    light: Light,
    choice: Choice,
) -> np.ndarray:
    """Colour, opacity and weight (h, w, C + 2) of a partition, reprojected, with the guard bands of segment and pupil. shape: h, w, C."""
    height, width, channels = shape
    around = guards[3]
    guard_x, guard_y = guards[0] + guards[2] + around, guards[1] + guards[2] + around
    planes = np.zeros((height + 2 * guard_y, width + 2 * guard_x, channels + 3), np.float32)
    reproject(planes, left - guard_x, top - guard_y, slope, j, partitions, light, choice.shared_out)
    planes = evened_out(planes, choice.enough)
    smooth(planes, rest)
    return np.ascontiguousarray(planes[around : planes.shape[0] - around, around : planes.shape[1] - around])


@njit(cache=True, nogil=True)
def lay_parts(
    pictures: np.ndarray,
    seen_past: np.ndarray,
    planes: np.ndarray,
    scale: float,
    length_x: float,
    length_y: float,
    guards: tuple,
    pupil: Pupil,
) -> None:
    """What moves by less than a pixel is the same at all times, and what is in focus through all of the pupil."""
    cells, times, height, width, channels = pictures.shape
    layer = np.empty((height, width, channels + 2), np.float32)
    blurred = np.empty((height + 2 * guards[1], width + 2 * guards[0], channels + 2), np.float32)
    prefix = sums_along_x(planes)
    is_point, is_still = abs(scale) < LEAST_SCALE_PX, abs(length_x) < 1.0 and abs(length_y) < 1.0
    for cell in range(cells):
        if cell == 0 or not is_point:
            pupil_filter(blurred, planes, prefix, drawing(pupil, scale, cell), scale, guards[2])
        for time in range(times):
            if (time == 0 or not is_still) and not (is_point and is_still and cell > 0):
                # What lies at x0 is carried to x0 + length t, so the light of a pixel is read around x - length t.
                offsets, weights = line_taps(-length_x, -length_y, time / times - 0.5, (time + 1) / times - 0.5)
                along_line(layer, blurred, offsets, weights, guards[0], guards[1])
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
