"""Rays from a point through the spherical surfaces of a lens to the sensor, and the chief ray among them, compiled.

A table has a row per surface: z, curvature, squared aperture radius, Cauchy A and B. Light travels towards +z; millimetres and
micrometres (wavelengths). The meridional plane, which holds the axis and the source, is y = 0.
"""

from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit


class Optics(NamedTuple):
    """A lens and where it is focused. chiefs (nodes, 5): where the sensor is met (x) and the chief ray, evenly over eccentricity."""

    table: np.ndarray
    chiefs: np.ndarray
    front_mm: float
    sensor_mm: float


class Rays(NamedTuple):
    """Rays to trace. shares (rays, 3): a, b and the wavelength in its band. field (rays): place among the chief rays, 0 to nodes - 1."""

    shares: np.ndarray
    per_mm: np.ndarray
    field: np.ndarray


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
    """Trace the ray through the middle of the stop whose slope just behind it is given; rims do not block it.

    Fills chief (4: x, z at the first surface, direction x, z) and returns where it meets the sensor (x); nan if it is lost.
    """
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
    """Find the chief ray to target_mm <= 0 on the sensor (x): `_through_stop` solved by stepping and halving; False beyond the field."""
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


@njit(cache=True, nogil=True)
def trace_point(
    table: np.ndarray,
    chief: np.ndarray,
    front_mm: float,
    per_mm: float,
    a_mm: float,
    b_mm: float,
    wavelength_um: float,
    sensor_mm: float,
    ray: np.ndarray,
    landing: np.ndarray,
) -> float:
    """Trace one ray from a point on the chief ray; fills landing (2: x, y on the sensor), returns its weight, 0 if it does not arrive.

    per_mm: 1 / distance of the point from the plane z = front_mm along the axis, 0 is infinitely far. The ray
    crosses the plane at a right angle to the chief ray, where that meets the first surface, a_mm (meridional) and b_mm
    (along y) from it. A source shines evenly into all directions: the weight is the solid angle of a unit of that plane
    relative to its middle. ray (6) is a place to work in.
    """
    near = chief[3] * per_mm / (1.0 + (chief[1] - front_mm) * per_mm)
    aside = 1.0 + (a_mm * a_mm + b_mm * b_mm) * near * near
    length = np.sqrt(aside)
    ray[0], ray[1], ray[2] = chief[0] + a_mm * chief[3], b_mm, chief[1] - a_mm * chief[2]
    ray[3] = (chief[2] + a_mm * near * chief[3]) / length
    ray[4] = b_mm * near / length
    ray[5] = (chief[3] - a_mm * near * chief[2]) / length
    if ray[5] <= 0.0 or not trace_ray(table, 0, 1.0, ray, wavelength_um, True) or ray[5] <= 0.0:
        return 0.0
    path = (sensor_mm - ray[2]) / ray[5]
    landing[0], landing[1] = ray[0] + path * ray[3], ray[1] + path * ray[4]
    return 1.0 / (aside * length)


@njit(cache=True, nogil=True)
def open_window(
    table: np.ndarray,
    chief: np.ndarray,
    front_mm: float,
    per_mm: float,
    wavelength_um: float,
    sensor_mm: float,
    window: np.ndarray,
    steps: int,
    found: np.ndarray,
) -> None:
    """Widen found (3: a from, a to, |b| to) around the cells of a steps x steps grid over window (3) that let light pass."""
    ray, landing = np.empty(6), np.empty(2)
    a_step, b_step = (window[1] - window[0]) / steps, window[2] / steps
    for i in range(steps):
        for j in range(steps):
            a, b = window[0] + (i + 0.5) * a_step, (j + 0.5) * b_step
            if trace_point(table, chief, front_mm, per_mm, a, b, wavelength_um, sensor_mm, ray, landing) > 0.0:
                found[0], found[1] = min(found[0], a - a_step), max(found[1], a + a_step)
                found[2] = max(found[2], b + b_step)


@njit(cache=True, nogil=True)
def trace_rays(optics: Optics, window: np.ndarray, rays: Rays, bands_um: np.ndarray, landings: np.ndarray, weights: np.ndarray) -> None:
    """Trace rays for all colours: landings (rays, colours, 2) in mm from the chief ray's place, weights (rays, colours).

    bands_um (colours, 2): middle and half width of a triangle.
    """
    table, chiefs, front_mm, sensor_mm = optics
    shares, per_mm, field = rays
    chief, ray, landing = np.empty(4), np.empty(6), np.empty(2)
    for i in range(shares.shape[0]):
        node = min(int(field[i]), max(chiefs.shape[0] - 2, 0))
        part, following = field[i] - node, min(node + 1, chiefs.shape[0] - 1)
        for k in range(4):
            chief[k] = (1.0 - part) * chiefs[node, k + 1] + part * chiefs[following, k + 1]
        length = np.sqrt(chief[2] * chief[2] + chief[3] * chief[3])
        chief[2], chief[3] = chief[2] / length, chief[3] / length
        middle = (1.0 - part) * chiefs[node, 0] + part * chiefs[following, 0]
        a, b = window[0] + (window[1] - window[0]) * shares[i, 0], window[2] * shares[i, 1]
        share = shares[i, 2]
        tent = np.sqrt(2.0 * share) - 1.0 if share < 0.5 else 1.0 - np.sqrt(2.0 - 2.0 * share)
        for colour in range(bands_um.shape[0]):
            wavelength_um = bands_um[colour, 0] + bands_um[colour, 1] * tent
            weight = trace_point(table, chief, front_mm, per_mm[i], a, b, wavelength_um, sensor_mm, ray, landing)
            weights[i, colour] = weight / max(chief[3], 1e-6)
            landings[i, colour, 0], landings[i, colour, 1] = landing[0] - middle, landing[1]


@njit(cache=True, nogil=True)
def add_landings(kernel: np.ndarray, landings: np.ndarray, weights: np.ndarray, mm_per_px: float) -> None:
    """Add rays to kernel (K, K, colours), each with its mirror image in the meridional plane; the sensor's picture is upside down."""
    size = kernel.shape[0]
    centre = 0.5 * size
    for ray in range(weights.shape[0]):
        for colour in range(weights.shape[1]):
            weight = 0.5 * weights[ray, colour]
            if weight > 0.0:
                column = int(np.floor(centre - landings[ray, colour, 0] / mm_per_px))
                aside = landings[ray, colour, 1] / mm_per_px
                above, below = int(np.floor(centre - aside)), int(np.floor(centre + aside))
                if 0 <= column < size and 0 <= above < size and 0 <= below < size:
                    kernel[above, column, colour] += weight
                    kernel[below, column, colour] += weight
