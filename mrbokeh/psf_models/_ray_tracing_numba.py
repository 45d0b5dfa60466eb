"""Rays through spherical surfaces, and the chief ray among them, compiled.

A table has a row per surface: z, curvature, squared aperture radius, Cauchy A and B. Light travels towards +z; millimetres and
micrometres (wavelengths). The meridional plane, which holds the axis and the source, is y = 0.
"""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def trace_ray(table: np.ndarray, first: int, index: float, ray: np.ndarray, wavelength_um: float, with_rims: bool) -> bool:
    """Take ray (6: position, unit direction) in place through surfaces `first` to the last; False where it is blocked or lost.

    index: of the medium in which it starts. Transfer and refraction as in Welford, Aberrations of Optical Systems, 4.2-4.3:
    to the plane of the vertex, from there to the sphere, then Snell's law in vectors.
    """
    for surface in range(first, table.shape[0]):
        vertex, curvature = table[surface, 0], table[surface, 1]
        if ray[5] == 0.0:
            return False
        path = (vertex - ray[2]) / ray[5]
        x, y = ray[0] + path * ray[3], ray[1] + path * ray[4]
        slant = ray[5] - curvature * (x * ray[3] + y * ray[4])
        square = slant * slant - curvature * curvature * (x * x + y * y)
        if square < 0.0:
            return False
        cosine = np.sqrt(square)
        path = curvature * (x * x + y * y) / (slant + cosine)
        ray[0], ray[1], ray[2] = x + path * ray[3], y + path * ray[4], vertex + path * ray[5]
        if with_rims and ray[0] * ray[0] + ray[1] * ray[1] > table[surface, 2]:
            return False
        behind = table[surface, 3] + table[surface, 4] / (wavelength_um * wavelength_um)
        ratio = index / behind
        square = 1.0 - ratio * ratio * (1.0 - cosine * cosine)
        if square < 0.0:
            return False
        turn = np.sqrt(square) - ratio * cosine
        ray[3] = ratio * ray[3] - turn * curvature * ray[0]
        ray[4] = ratio * ray[4] - turn * curvature * ray[1]
        ray[5] = ratio * ray[5] + turn * (1.0 - curvature * (ray[2] - vertex))
        index = behind
    return True


@njit(cache=True, nogil=True)
def _through_stop(
    table: np.ndarray, reverse: np.ndarray, stop: int, slope: float, wavelength_um: float, sensor_mm: float, chief: np.ndarray
) -> float:
    """The ray through the middle of the stop whose slope is given just behind it: chief (4: x, z at the first surface, direction
    x, z) and where it meets the sensor (x); nan where it is lost. Rims are not asked."""
    last = table.shape[0] - 1
    length, behind = np.sqrt(1.0 + slope * slope), table[stop, 3] + table[stop, 4] / (wavelength_um * wavelength_um)
    ray = np.array([0.0, 0.0, table[stop, 0], slope / length, 0.0, 1.0 / length])
    back = np.array([0.0, 0.0, table[last, 0] - table[stop, 0], -slope / length, 0.0, 1.0 / length])
    if not trace_ray(table, stop + 1, behind, ray, wavelength_um, False) or ray[5] <= 0.0:
        return np.nan
    if not trace_ray(reverse, last - stop, behind, back, wavelength_um, False):
        return np.nan
    chief[0], chief[1], chief[2], chief[3] = back[0], table[last, 0] - back[2], -back[3], back[5]
    return ray[0] + (sensor_mm - ray[2]) * ray[3] / ray[5]


@njit(cache=True, nogil=True)
def find_chief(
    table: np.ndarray, reverse: np.ndarray, stop: int, wavelength_um: float, sensor_mm: float, target_mm: float, chief: np.ndarray
) -> bool:
    """The chief ray to target_mm <= 0 on the sensor (x): `_through_stop` solved by stepping and halving; False beyond the field."""
    low, step = 0.0, 1.0 / 256.0
    while True:
        if low >= 1.5:
            return False
        place = _through_stop(table, reverse, stop, -np.tan(low + step), wavelength_um, sensor_mm, chief)
        if np.isnan(place):
            if step < 1e-7:
                return False
            step *= 0.5
            continue
        if place <= target_mm:
            break
        low += step
    high = low + step
    for _ in range(48):
        middle = 0.5 * (low + high)
        if _through_stop(table, reverse, stop, -np.tan(middle), wavelength_um, sensor_mm, chief) > target_mm:
            low = middle
        else:
            high = middle
    if target_mm == 0.0:
        high = 0.0
    return not np.isnan(_through_stop(table, reverse, stop, -np.tan(high), wavelength_um, sensor_mm, chief))
