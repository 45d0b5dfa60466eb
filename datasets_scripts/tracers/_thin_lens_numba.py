"""Compiled kernels of the thin-lens tracer: what a ray meets first, the light that comes back, the picture, and baked visibility.

Camera axes and metres; a ray of the picture has d_z = 1, so that its parameter t is depth.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from mrbokeh.system.compiled import njit

NOTHING = -1
# Without "ninf" and "nnan": a missed body is at infinity.
FAST = {"reassoc", "contract", "arcp", "nsz"}
TILE_PX = 8


class PackedScene(NamedTuple):
    """A scene as arrays. Bodies are numbered quads first, then spheres, then lights.

    quad_dual_u/v: the dual basis of the edges, so that dot(dual, point - corner) is the position along that edge.
    bounds_px: (bodies, 4) x0, y0, x1, y1 of all that a body's blur can touch.
    light_gain: (lights,) share of the pupil's light per light sample, or 0 where the lens rays themselves see the light.
    texture_map, lightmap: (n, 3) start, height, width within texels and lightmap_values.
    """

    quad_corner: np.ndarray
    quad_normal: np.ndarray
    quad_dual_u: np.ndarray
    quad_dual_v: np.ndarray
    quad_repeats: np.ndarray
    quad_texture: np.ndarray
    sphere_centre: np.ndarray
    sphere_radius: np.ndarray
    sphere_repeats: np.ndarray
    sphere_texture: np.ndarray
    light_centre: np.ndarray
    light_radius: np.ndarray
    light_rgb: np.ndarray
    light_gain: np.ndarray
    bounds_px: np.ndarray
    texels: np.ndarray
    texture_map: np.ndarray
    lightmap_values: np.ndarray
    lightmap: np.ndarray
    world_from_camera: np.ndarray
    sun_direction: np.ndarray
    sun: float
    ambient: float
    background_rgb: np.ndarray


@njit(cache=True, fastmath=FAST)
def _quad_hit(s: PackedScene, i: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> tuple[float, float, float]:
    """Return (t, position along edge u, along edge v); t is inf where the ray misses."""
    nx, ny, nz = s.quad_normal[i, 0], s.quad_normal[i, 1], s.quad_normal[i, 2]
    along = nx * dx + ny * dy + nz * dz
    if along == 0.0:
        return math.inf, 0.0, 0.0
    cx, cy, cz = ox - s.quad_corner[i, 0], oy - s.quad_corner[i, 1], oz - s.quad_corner[i, 2]
    t = -(nx * cx + ny * cy + nz * cz) / along
    px, py, pz = cx + t * dx, cy + t * dy, cz + t * dz
    u = s.quad_dual_u[i, 0] * px + s.quad_dual_u[i, 1] * py + s.quad_dual_u[i, 2] * pz
    v = s.quad_dual_v[i, 0] * px + s.quad_dual_v[i, 1] * py + s.quad_dual_v[i, 2] * pz
    if t <= 0.0 or u < 0.0 or u > 1.0 or v < 0.0 or v > 1.0:
        return math.inf, 0.0, 0.0
    return t, u, v


@njit(cache=True, fastmath=FAST)
def _sphere_hit(s: PackedScene, i: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> float:
    cx, cy, cz = ox - s.sphere_centre[i, 0], oy - s.sphere_centre[i, 1], oz - s.sphere_centre[i, 2]
    a = dx * dx + dy * dy + dz * dz
    b = cx * dx + cy * dy + cz * dz
    discriminant = b * b - a * (cx * cx + cy * cy + cz * cz - s.sphere_radius[i] ** 2)
    if discriminant < 0.0:
        return math.inf
    root = math.sqrt(discriminant)
    near = (-b - root) / a
    t = near if near > 0.0 else (-b + root) / a
    return t if t > 0.0 else math.inf


@njit(cache=True, fastmath=FAST)
def _light_hit(s: PackedScene, i: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float) -> float:
    """Return t of the hit, or inf; a light is a disc parallel to the sensor."""
    t = (s.light_centre[i, 2] - oz) / dz
    x, y = ox + t * dx - s.light_centre[i, 0], oy + t * dy - s.light_centre[i, 1]
    return t if t > 0.0 and x * x + y * y <= s.light_radius[i] ** 2 else math.inf


@njit(cache=True, fastmath=FAST)
def nearest_hit(
    s: PackedScene, members: np.ndarray, count: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[int, float, float, float]:
    """Return (body, t, edge position u, v) of the first of `members[:count]` that the ray o + t d meets; NOTHING and inf if none."""
    quads, spheres = s.quad_corner.shape[0], s.sphere_centre.shape[0]
    best, best_t, best_u, best_v = NOTHING, math.inf, 0.0, 0.0
    for m in range(count):
        body = members[m]
        u, v = 0.0, 0.0
        if body < quads:
            t, u, v = _quad_hit(s, body, ox, oy, oz, dx, dy, dz)
        elif body < quads + spheres:
            t = _sphere_hit(s, body - quads, ox, oy, oz, dx, dy, dz)
        else:
            t = _light_hit(s, body - quads - spheres, ox, oy, oz, dx, dy, dz)
        if t < best_t:
            best, best_t, best_u, best_v = body, t, u, v
    return best, best_t, best_u, best_v


@njit(cache=True, fastmath=FAST)
def _texture_rgb(s: PackedScene, texture: int, u: float, v: float) -> tuple[float, float, float]:
    """Return a repeating texture, bilinear; texel (0, 0)'s centre is half a texel from the corner."""
    start, height, width = s.texture_map[texture, 0], s.texture_map[texture, 1], s.texture_map[texture, 2]
    x, y = (u - math.floor(u)) * width - 0.5, (v - math.floor(v)) * height - 0.5
    x0, y0 = math.floor(x), math.floor(y)
    fx, fy = x - x0, y - y0
    left, right = (x0 if x0 >= 0 else width - 1), (x0 + 1 if x0 + 1 < width else 0)
    top = start + (y0 if y0 >= 0 else height - 1) * width
    bottom = start + (y0 + 1 if y0 + 1 < height else 0) * width
    w00, w01, w10, w11 = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    a, b, c, d = top + left, top + right, bottom + left, bottom + right
    return (
        w00 * s.texels[a, 0] + w01 * s.texels[b, 0] + w10 * s.texels[c, 0] + w11 * s.texels[d, 0],
        w00 * s.texels[a, 1] + w01 * s.texels[b, 1] + w10 * s.texels[c, 1] + w11 * s.texels[d, 1],
        w00 * s.texels[a, 2] + w01 * s.texels[b, 2] + w10 * s.texels[c, 2] + w11 * s.texels[d, 2],
    )


@njit(cache=True, fastmath=FAST)
def _lightmap_gain(s: PackedScene, quad: int, u: float, v: float) -> float:
    """Return the lightmap, bilinear between texel centres, held constant outside them."""
    start, height, width = s.lightmap[quad, 0], s.lightmap[quad, 1], s.lightmap[quad, 2]
    x, y = min(max(u * width - 0.5, 0.0), width - 1.0), min(max(v * height - 0.5, 0.0), height - 1.0)
    x0, y0 = int(x), int(y)
    x1, y1 = min(x0 + 1, width - 1), min(y0 + 1, height - 1)
    fx, fy = x - x0, y - y0
    top = (1 - fx) * s.lightmap_values[start + y0 * width + x0] + fx * s.lightmap_values[start + y0 * width + x1]
    bottom = (1 - fx) * s.lightmap_values[start + y1 * width + x0] + fx * s.lightmap_values[start + y1 * width + x1]
    return (1 - fy) * top + fy * bottom


@njit(cache=True, fastmath=FAST)
def _sphere_rgb(s: PackedScene, i: int, px: float, py: float, pz: float) -> tuple[float, float, float]:
    """Return Lambert shading under the sun and a sky that fades downwards; the texture's longitude runs about the world's x axis."""
    r = s.sphere_radius[i]
    nx, ny, nz = (px - s.sphere_centre[i, 0]) / r, (py - s.sphere_centre[i, 1]) / r, (pz - s.sphere_centre[i, 2]) / r
    m = s.world_from_camera
    wx = m[0, 0] * nx + m[0, 1] * ny + m[0, 2] * nz
    wy = m[1, 0] * nx + m[1, 1] * ny + m[1, 2] * nz
    wz = m[2, 0] * nx + m[2, 1] * ny + m[2, 2] * nz
    u = 0.5 + math.atan2(wy, -wz) / (2.0 * math.pi)
    v = math.acos(min(max(wx, -1.0), 1.0)) / math.pi
    red, green, blue = _texture_rgb(s, s.sphere_texture[i], u * s.sphere_repeats[i, 0], v * s.sphere_repeats[i, 1])
    facing = nx * s.sun_direction[0] + ny * s.sun_direction[1] + nz * s.sun_direction[2]
    gain = s.ambient * (0.65 - 0.35 * wy) + s.sun * max(facing, 0.0)
    return red * gain, green * gain, blue * gain


@njit(cache=True, fastmath=FAST)
def radiance(s: PackedScene, members: np.ndarray, count: int, ox: float, oy: float, dx: float, dy: float) -> tuple[float, float, float]:
    """Return the linear RGB that comes back along a ray from the lens point (ox, oy, 0)."""
    quads, spheres = s.quad_corner.shape[0], s.sphere_centre.shape[0]
    body, t, u, v = nearest_hit(s, members, count, ox, oy, 0.0, dx, dy, 1.0)
    if body == NOTHING:
        return s.background_rgb[0], s.background_rgb[1], s.background_rgb[2]
    if body < quads:
        red, green, blue = _texture_rgb(s, s.quad_texture[body], u * s.quad_repeats[body, 0], v * s.quad_repeats[body, 1])
        gain = _lightmap_gain(s, body, u, v)
        return red * gain, green * gain, blue * gain
    if body < quads + spheres:
        return _sphere_rgb(s, body - quads, ox + t * dx, oy + t * dy, t)
    light = body - quads - spheres
    if s.light_gain[light] > 0.0:
        return 0.0, 0.0, 0.0
    return s.light_rgb[light, 0], s.light_rgb[light, 1], s.light_rgb[light, 2]


class PackedView(NamedTuple):
    """A camera with a lens: focal (x, y) and principal point in pixels, pupil radius in metres, 1 / focus distance.

    footprint: side in pixels of the square over which a pixel averages. pupil_extent: half side of the square around the outlines.
    clear: (outlines, 3) squared distance of the outline's nearest and farthest place from the middle, 1 where the middle lies within.
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
    clear: np.ndarray


@njit(cache=True, inline="always")
def _fraction_hash(state: np.uint32) -> float:
    """Return a well-mixed number in [0, 1) (the finaliser of MurmurHash3)."""
    h = np.uint32(state)
    h = np.uint32((h ^ (h >> np.uint32(16))) * np.uint32(0x85EBCA6B))
    h = np.uint32((h ^ (h >> np.uint32(13))) * np.uint32(0xC2B2AE35))
    return float(np.uint32(h ^ (h >> np.uint32(16)))) / 4294967296.0


@njit(cache=True, fastmath=FAST, inline="always")
def _ray_slope(pixel: int, jitter: float, footprint: float, principal: float, focal: float) -> float:
    """Return x / z (or y / z) of the pinhole ray through a point of the pixel's footprint; jitter counts modulo 1."""
    return (pixel + 0.5 + (jitter - math.floor(jitter) - 0.5) * footprint - principal) / focal


@njit(cache=True, fastmath=FAST)
def pupil_weight(view: PackedView, x: float, y: float) -> float:
    """Return the weighted sum of the outlines that hold the lens point (even-odd rule)."""
    total, away = 0.0, x * x + y * y
    for k in range(view.weights.shape[0]):
        if away < view.clear[k, 0] or away > view.clear[k, 1]:
            if away < view.clear[k, 0] and view.clear[k, 2] > 0.0:
                total += view.weights[k]
            continue
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
    """Return the share of the pupil through which a pixel sees one strongly blurred light, by points on the light, not on the lens."""
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
    """Fill rgb with the mean over the pixel's area and the pupil, divided by the weight that the pupil really gave (ratio estimator)."""
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


@njit(cache=True, fastmath=FAST, parallel=True)
def open_share(s: PackedScene, members: np.ndarray, points: np.ndarray, directions: np.ndarray, reach_m: float) -> np.ndarray:
    """Return the share (P,) of the rays from each point (P, 3) that meets none of the bodies `members` within reach_m.

    A nearer hit counts as open by distance / reach_m, so that a large reach gives a hard answer and a short one a soft one.
    """
    share = np.empty(points.shape[0])
    for p in prange(points.shape[0]):
        free = 0.0
        for i in range(directions.shape[0]):
            dx, dy, dz = directions[i, 0], directions[i, 1], directions[i, 2]
            t = nearest_hit(s, members, members.shape[0], points[p, 0], points[p, 1], points[p, 2], dx, dy, dz)[1]
            free += min(t / reach_m, 1.0)
        share[p] = free / directions.shape[0]
    return share
