"""Compiled kernels of the thin-lens tracer. Camera axes and metres; t is depth because every ray has d_z = 1."""

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from datasets_scripts._traced_bodies_numba import FAST, PackedScene, nearest_hit, radiance
from mrbokeh.system.kernels import njit

TILE_PX = 8


class PackedView(NamedTuple):
    """A camera with a lens: focal (x, y) and principal point in pixels, pupil radius in metres, 1 / focus distance.

    footprint: side in pixels of the square over which a pixel averages. pupil_extent: half side of the square around the outlines.
    """

    width: int
    height: int
    focal_x: float
    focal_y: float
    principal_x: float
    principal_y: float
    footprint: float
    pupil_radius: float
    inverse_focus: float
    pupil_extent: float
    vertices: np.ndarray
    starts: np.ndarray
    weights: np.ndarray


@njit(cache=True, inline="always")
def _fraction_hash(state: np.uint32) -> float:
    """A well-mixed number in [0, 1) (the finaliser of MurmurHash3)."""
    h = np.uint32(state)
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x85EBCA6B))
    h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35))
    return float(np.uint32(h ^ (h >> np.uint32(16)))) / 4294967296.0


@njit(cache=True, fastmath=FAST, inline="always")
def _ray_slope(pixel: int, jitter: float, footprint: float, principal: float, focal: float) -> float:
    """x / z (or y / z) of the pinhole ray through a point of the pixel's footprint; jitter counts modulo 1."""
    return (pixel + 0.5 + (jitter - math.floor(jitter) - 0.5) * footprint - principal) / focal


@njit(cache=True, fastmath=FAST)
def pupil_weight(view: PackedView, x: float, y: float) -> float:
    """The weighted sum of the outlines that hold the lens point (even-odd rule)."""
    total = 0.0
    for k in range(view.weights.shape[0]):
        inside = False
        start, stop = view.starts[k], view.starts[k + 1]
        j = stop - 1
        for i in range(start, stop):
            xi, yi, xj, yj = view.vertices[i, 0], view.vertices[i, 1], view.vertices[j, 0], view.vertices[j, 1]
            if (yi > y) != (yj > y) and x < (xj - xi) * (y - yi) / (yj - yi) + xi:
                inside = not inside
            j = i
        if inside:
            total += view.weights[k]
    return total


@njit(cache=True, fastmath=FAST)
def _light_share(
    s: PackedScene,
    view: PackedView,
    members: np.ndarray,
    count: int,
    light: int,
    column: int,
    row: int,
    shift: np.ndarray,
    points: np.ndarray,
) -> float:
    """Share of the pupil through which a pixel sees one strongly blurred light: points on the light instead of on the lens."""
    body = s.quad_corner.shape[0] + s.sphere_centre.shape[0] + light
    cx, cy, cz = s.light_centre[light, 0], s.light_centre[light, 1], s.light_centre[light, 2]
    per_pupil = 1.0 / ((1.0 - cz * view.inverse_focus) * view.pupil_radius)
    total = 0.0
    for n in range(points.shape[0]):
        q0, q1, q2, q3 = points[n, 0] + shift[0], points[n, 1] + shift[1], points[n, 2] + shift[2], points[n, 3] + shift[3]
        dir_x = _ray_slope(column, q0, view.footprint, view.principal_x, view.focal_x)
        dir_y = _ray_slope(row, q1, view.footprint, view.principal_y, view.focal_y)
        radius, angle = s.light_radius[light] * math.sqrt(q2 - math.floor(q2)), 2.0 * math.pi * q3
        lens_x = (cx + radius * math.cos(angle) - dir_x * cz) * per_pupil
        lens_y = (cy + radius * math.sin(angle) - dir_y * cz) * per_pupil
        weight = pupil_weight(view, lens_x, lens_y)
        if weight == 0.0:
            continue
        ox, oy = lens_x * view.pupil_radius, lens_y * view.pupil_radius
        hit, t, _, _ = nearest_hit(s, members, count, ox, oy, 0.0, dir_x - ox * view.inverse_focus, dir_y - oy * view.inverse_focus, 1.0)
        if hit == body or t > cz * (1.0 - 1e-9):
            total += weight
    return total / points.shape[0] * s.light_gain[light]


@njit(cache=True, fastmath=FAST)
def _shade_pixel(
    s: PackedScene,
    view: PackedView,
    members: np.ndarray,
    count: int,
    column: int,
    row: int,
    shift: np.ndarray,
    points: np.ndarray,
    rgb: np.ndarray,
) -> None:
    """Mean radiance over the pixel's area and the pupil, divided by the weight that the pupil really gave (ratio estimator)."""
    red, green, blue, total = 0.0, 0.0, 0.0, 0.0
    for n in range(points.shape[0]):
        q2, q3 = points[n, 2] + shift[2], points[n, 3] + shift[3]
        lens_x = (2.0 * (q2 - math.floor(q2)) - 1.0) * view.pupil_extent
        lens_y = (2.0 * (q3 - math.floor(q3)) - 1.0) * view.pupil_extent
        weight = pupil_weight(view, lens_x, lens_y)
        if weight == 0.0:
            continue
        q0, q1 = points[n, 0] + shift[0], points[n, 1] + shift[1]
        ox, oy = lens_x * view.pupil_radius, lens_y * view.pupil_radius
        dx = _ray_slope(column, q0, view.footprint, view.principal_x, view.focal_x) - ox * view.inverse_focus
        dy = _ray_slope(row, q1, view.footprint, view.principal_y, view.focal_y) - oy * view.inverse_focus
        r, g, b = radiance(s, members, count, ox, oy, dx, dy)
        red, green, blue, total = red + weight * r, green + weight * g, blue + weight * b, total + weight
    total = max(total, 1e-12)
    rgb[0], rgb[1], rgb[2] = red / total, green / total, blue / total


@njit(cache=True)
def _members_of_tile(bounds_px: np.ndarray, x0: int, y0: int, members: np.ndarray) -> int:
    count = 0
    for body in range(bounds_px.shape[0]):
        overlaps_x = bounds_px[body, 0] <= x0 + TILE_PX and bounds_px[body, 2] >= x0
        if overlaps_x and bounds_px[body, 1] <= y0 + TILE_PX and bounds_px[body, 3] >= y0:
            members[count] = body
            count += 1
    return count


@njit(cache=True, fastmath=FAST)
def _shade_tile(
    s: PackedScene, view: PackedView, x0: int, y0: int, points: np.ndarray, light_points: np.ndarray, seed: int, rgb: np.ndarray
) -> None:
    members, shift = np.empty(s.bounds_px.shape[0], np.int64), np.empty(4)
    count = _members_of_tile(s.bounds_px, x0, y0, members)
    first_light = s.quad_corner.shape[0] + s.sphere_centre.shape[0]
    for row in range(y0, min(y0 + TILE_PX, view.height)):
        for column in range(x0, min(x0 + TILE_PX, view.width)):
            for axis in range(4):
                number = (row * view.width + column) * 4 + axis
                shift[axis] = _fraction_hash(np.uint32(number * 0x9E3779B1 + seed * 0x7FEB352D + 0x165667B1))
            _shade_pixel(s, view, members, count, column, row, shift, points, rgb[row, column])
            for m in range(count):
                light = members[m] - first_light
                if light >= 0 and s.light_gain[light] > 0.0:
                    share = _light_share(s, view, members, count, light, column, row, shift, light_points)
                    for c in range(3):
                        rgb[row, column, c] += share * s.light_rgb[light, c]


@njit(cache=True, parallel=True)
def shade_picture(s: PackedScene, view: PackedView, points: np.ndarray, light_points: np.ndarray, seed: int, rgb: np.ndarray) -> None:
    """Fill rgb (H, W, 3), tile by tile."""
    tiles_x = (view.width + TILE_PX - 1) // TILE_PX
    tiles_y = (view.height + TILE_PX - 1) // TILE_PX
    for tile in prange(tiles_x * tiles_y):
        _shade_tile(s, view, tile % tiles_x * TILE_PX, tile // tiles_x * TILE_PX, points, light_points, seed, rgb)


@njit(cache=True, parallel=True)
def trace_depth(s: PackedScene, view: PackedView, depth_m: np.ndarray) -> None:
    """Fill depth_m (H, W) with the depth of the first body behind each pixel's centre, seen from the middle of the lens."""
    everything = np.arange(s.bounds_px.shape[0])
    for row in prange(view.height):
        for column in range(view.width):
            dx = (column + 0.5 - view.principal_x) / view.focal_x
            dy = (row + 0.5 - view.principal_y) / view.focal_y
            depth_m[row, column] = nearest_hit(s, everything, everything.shape[0], 0.0, 0.0, 0.0, dx, dy, 1.0)[1]
