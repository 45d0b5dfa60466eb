"""Kernels of apertures, compiled: exact pixel coverage of polygons, and the lookup of drawn diameters."""

import math

import numpy as np

from mrbokeh.system.compiled import njit

ROUNDING = 1e-15
"""Part of a kernel's light below which a pixel's is what running sums leave of rounding, another on other processors: none."""


@njit(cache=True, nogil=True)
def _mean_ramp(t: float, low: float, high: float) -> float:
    """Return the mean of max(0, t - x) for x spread evenly over [low, high]."""
    if t <= low:
        return 0.0
    if t >= high:
        return t - 0.5 * (low + high)
    return (t - low) ** 2 / (2.0 * (high - low))


@njit(cache=True, nogil=True)
def _add_edge(steps: np.ndarray, x0: float, y0: float, x1: float, y1: float) -> None:
    """Add one directed edge; the running sum of `steps` along a row is the area to the right of the edge."""
    if y0 == y1:
        return
    sign = 1.0 if y1 > y0 else -1.0
    top, bottom = min(y0, y1), max(y0, y1)
    slope = (x1 - x0) / (y1 - y0)
    for row in range(int(math.floor(top)), int(math.ceil(bottom))):
        y_in, y_out = max(top, float(row)), min(bottom, row + 1.0)
        xa, xb = x0 + (y_in - y0) * slope, x0 + (y_out - y0) * slope
        low, high = min(xa, xb), max(xa, xb)
        weight = sign * (y_out - y_in)
        for column in range(int(math.floor(low)), min(int(math.floor(high)) + 2, steps.shape[1])):
            ramp_change = _mean_ramp(column + 1.0, low, high) - 2.0 * _mean_ramp(column, low, high) + _mean_ramp(column - 1.0, low, high)
            steps[row, column] += weight * ramp_change


@njit(cache=True, nogil=True)
def add_polygon_coverage(kernel: np.ndarray, steps: np.ndarray, outline: np.ndarray, scale_px: float, weight: float) -> None:
    """Add `weight` times the coverage of `outline * scale_px`, centred in `kernel` (K, K), K odd, large enough to hold it.

    steps is scratch space (K, K), zeroed here. A negative scale mirrors the outline through its origin. The winding
    direction does not matter; the outline must not cross itself.
    """
    size = kernel.shape[0]
    centre = 0.5 * size
    steps[:] = 0.0
    doubled_area = 0.0
    count = outline.shape[0]
    for i in range(count):
        j = (i + 1) % count
        x0, y0 = outline[i, 0] * scale_px + centre, outline[i, 1] * scale_px + centre
        x1, y1 = outline[j, 0] * scale_px + centre, outline[j, 1] * scale_px + centre
        doubled_area += (x0 - centre) * (y1 - centre) - (x1 - centre) * (y0 - centre)
        _add_edge(steps, x0, y0, x1, y1)
    signed_weight = -weight if doubled_area > 0 else weight
    for row in range(size):
        coverage = 0.0
        for column in range(size):
            coverage += steps[row, column]
            kernel[row, column] += signed_weight * coverage


@njit(cache=True, nogil=True)
def _shown_diameter_px(diameter_px: float, unit_radius: float) -> float:
    """Return `mrbokeh.optics.psf.shown_diameter_px` of one number."""
    size = abs(diameter_px)
    if size <= 1.0:
        return 0.0
    full = 1.0 + 4.0 * (unit_radius - 1.0)
    if size >= full:
        return diameter_px
    size = 1.0 / unit_radius + (size - 1.0) * (full - 1.0 / unit_radius) / (full - 1.0)
    return size if diameter_px > 0.0 else -size


@njit(cache=True, nogil=True)
def fill_psf(kernel: np.ndarray, steps: np.ndarray, vertices: np.ndarray, starts: np.ndarray, weights: np.ndarray, coc_px: float) -> None:
    """Overwrite `kernel` with the normalised PSF of weighted polygons at a signed diameter; up to one pixel it is the identity.

    vertices: (V, 2) of all outlines one after the other; outline i is vertices[starts[i]:starts[i + 1]].
    """
    kernel[:] = 0.0
    reach = 0.0
    for i in range(vertices.shape[0]):
        reach = max(reach, vertices[i, 0] ** 2 + vertices[i, 1] ** 2)
    radius_px = 0.5 * _shown_diameter_px(coc_px, math.sqrt(reach))
    if radius_px == 0.0:
        kernel[kernel.shape[0] // 2, kernel.shape[1] // 2] = 1.0
        return
    for i in range(weights.shape[0]):
        add_polygon_coverage(kernel, steps, vertices[starts[i] : starts[i + 1]], radius_px, weights[i])
    light = kernel.sum()
    for y in range(kernel.shape[0]):
        for x in range(kernel.shape[1]):
            kernel[y, x] = kernel[y, x] / light if abs(kernel[y, x]) > ROUNDING * abs(light) else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def look_up(drawn: np.ndarray, coc_px: np.ndarray, table: np.ndarray, steps_per_px: int) -> None:
    """Look up signed float32 diameters: linear between two steps of the table, beyond the last by the difference of its squares."""
    last, steps = np.int32(len(table) - 1), np.float32(steps_per_px)
    widest = np.float32(last) / steps
    less = widest * widest - table[last] * table[last]
    for i in range(len(coc_px)):
        size = abs(coc_px[i])
        at = min(size, widest) * steps
        lower = max(min(np.int32(at), last - np.int32(1)), np.int32(0))
        near = table[lower] + (at - np.float32(lower)) * (table[lower + 1] - table[lower])
        wide = np.float32(math.sqrt(max(size * size - less, np.float32(0.0))))
        meant = near if size < widest else wide
        drawn[i] = meant if coc_px[i] >= np.float32(0.0) else -meant
