"""Compiled bodies of a traced scene: which one a ray meets first, and the light that comes back from it. Camera axes, metres."""

import math
from typing import NamedTuple

import numpy as np

from mrbokeh.system.kernels import njit

NOTHING = -1
# Without "ninf" and "nnan": a missed body is at infinity.
FAST = {"reassoc", "contract", "arcp", "nsz"}


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
    """(t, position along edge u, along edge v); t is inf where the ray misses."""
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
    """A light is a disc parallel to the sensor."""
    t = (s.light_centre[i, 2] - oz) / dz
    x, y = ox + t * dx - s.light_centre[i, 0], oy + t * dy - s.light_centre[i, 1]
    return t if t > 0.0 and x * x + y * y <= s.light_radius[i] ** 2 else math.inf


@njit(cache=True, fastmath=FAST)
def nearest_hit(
    s: PackedScene, members: np.ndarray, count: int, ox: float, oy: float, oz: float, dx: float, dy: float, dz: float
) -> tuple[int, float, float, float]:
    """(body, t, edge position u, v) of the first of `members[:count]` that the ray o + t d meets; body NOTHING and t inf if none."""
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
    """Bilinear, repeating; texel (0, 0)'s centre is half a texel from the corner."""
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
    """Bilinear between texel centres, held constant outside them."""
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
    """Lambert under the sun and a sky that fades downwards; longitude and latitude about the world's x axis carry the texture."""
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
    """Linear RGB that comes back along a ray from the lens point (ox, oy, 0)."""
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
