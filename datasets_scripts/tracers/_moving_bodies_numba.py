"""Compiled bodies that move in straight lines while the shutter is open, and the sampler's scrambled numbers.

Camera axes, metres; every ray has d_z = 1 and starts in the plane of the lens, so that its parameter t is depth. A body that
has moved by d is met by a ray as the body at rest is met by the ray moved by -d. Arrays are passed one by one because
reading them out of a tuple in an inner loop counts references each time. Numbers are Owen-scrambled Sobol points (see `sobol`).
"""

import math
from typing import NamedTuple

import numpy as np

from mrbokeh.system.kernels import njit

NOTHING = -1
QUAD, ROUND, SPHERE, LAMP = 0, 1, 2, 3
# Columns of the table of bodies: x, y, z from each of these on.
CENTRE, VELOCITY, HALF_BOX, NORMAL, DUAL_U, DUAL_V, RADIANCE = 0, 3, 6, 9, 12, 15, 18
RADIUS, GAIN, REPEAT_U, REPEAT_V, COLUMNS = 21, 22, 23, 24, 25
# Columns of the light: the sun's direction, its strength, that of the sky, and the background.
SUN_DIRECTION, SUN, SKY, BACKGROUND = 0, 3, 4, 5
DIMENSIONS = 5
PLACES = 4096
"""Film points per pixel and axis, so few that float32 holds them exactly in pictures of up to 2048 px."""
PER_BIT = 1.0 / 4294967296.0


class PackedBodies(NamedTuple):
    """A scene in motion.

    table: (bodies, COLUMNS) places in the middle of the exposure, velocities per shutter, half sides of the box around it.
    kind: (bodies,) QUAD to LAMP. bounds_px: (bodies, 4) x0, y0, x1, y1 of all that a body's blur can touch over the exposure.
    texture: (bodies, 3) start, height and width within texels. light: (8,).
    """

    table: np.ndarray
    kind: np.ndarray
    bounds_px: np.ndarray
    texture: np.ndarray
    texels: np.ndarray
    light: np.ndarray


@njit(cache=True, nogil=True)
def first_hit(
    table: np.ndarray,
    kind: np.ndarray,
    members: np.ndarray,
    count: int,
    ox: float,
    oy: float,
    dx: float,
    dy: float,
    since: float,
) -> tuple[int, float, float, float]:
    """Return (body or NOTHING, depth or inf, place u, v on a quad) of the first of `members[:count]`; since: time - 0.5, in shutters."""
    best, best_t, best_u, best_v = NOTHING, math.inf, 0.0, 0.0
    steep_x, steep_y = abs(dx), abs(dy)
    for m in range(count):
        i = members[m]
        cz = table[i, CENTRE + 2] + since * table[i, VELOCITY + 2]
        # The ray relative to the body's middle, at the depth of the middle.
        x = ox + dx * cz - table[i, CENTRE] - since * table[i, VELOCITY]
        y = oy + dy * cz - table[i, CENTRE + 1] - since * table[i, VELOCITY + 1]
        deep = table[i, HALF_BOX + 2]
        beside = abs(x) > table[i, HALF_BOX] + steep_x * deep or abs(y) > table[i, HALF_BOX + 1] + steep_y * deep
        if beside or cz - deep > best_t:
            continue
        s, u, v = math.inf, 0.5, 0.5
        if kind[i] <= ROUND:
            along = table[i, NORMAL] * dx + table[i, NORMAL + 1] * dy + table[i, NORMAL + 2]
            if along != 0.0:
                s = -(table[i, NORMAL] * x + table[i, NORMAL + 1] * y) / along
                px, py = x + s * dx, y + s * dy
                u = table[i, DUAL_U] * px + table[i, DUAL_U + 1] * py + table[i, DUAL_U + 2] * s + 0.5
                v = table[i, DUAL_V] * px + table[i, DUAL_V + 1] * py + table[i, DUAL_V + 2] * s + 0.5
                outside = u < 0.0 or u > 1.0 or v < 0.0 or v > 1.0
                if outside or (kind[i] == ROUND and (u - 0.5) ** 2 + (v - 0.5) ** 2 > 0.25):
                    s = math.inf
        elif kind[i] == SPHERE:
            a, b = dx * dx + dy * dy + 1.0, x * dx + y * dy
            discriminant = b * b - a * (x * x + y * y - table[i, RADIUS] ** 2)
            if discriminant >= 0.0:
                s = (-b - math.sqrt(discriminant)) / a
        elif x * x + y * y <= table[i, RADIUS] ** 2:
            s = 0.0
        if 0.0 < cz + s < best_t:
            best, best_t, best_u, best_v = i, cz + s, u, v
    return best, best_t, best_u, best_v


@njit(cache=True, nogil=True)
def _bilinear(texels: np.ndarray, start: int, height: int, width: int, u: float, v: float) -> tuple[float, float, float]:
    """Return a repeating texture; the centre of texel (0, 0) is half a texel from the corner."""
    x, y = (u - math.floor(u)) * width - 0.5, (v - math.floor(v)) * height - 0.5
    x0, y0 = int(math.floor(x)), int(math.floor(y))
    fx, fy = x - x0, y - y0
    left, right = (x0 + width) % width, (x0 + 1) % width
    top, bottom = start + (y0 + height) % height * width, start + (y0 + 1) % height * width
    w00, w01, w10, w11 = (1 - fx) * (1 - fy), fx * (1 - fy), (1 - fx) * fy, fx * fy
    a, b, c, d = top + left, top + right, bottom + left, bottom + right
    return (
        w00 * texels[a, 0] + w01 * texels[b, 0] + w10 * texels[c, 0] + w11 * texels[d, 0],
        w00 * texels[a, 1] + w01 * texels[b, 1] + w10 * texels[c, 1] + w11 * texels[d, 1],
        w00 * texels[a, 2] + w01 * texels[b, 2] + w10 * texels[c, 2] + w11 * texels[d, 2],
    )


@njit(cache=True, nogil=True)
def radiance_of(s: PackedBodies, i: int, t: float, u: float, v: float, x: float, y: float, since: float) -> tuple[float, float, float]:
    """Return the linear RGB of a hit at (x, y, t): Lambert under the sun and a sky, which on spheres fades downwards."""
    table, kind, texture, texels, light = s.table, s.kind, s.texture, s.texels, s.light
    if i == NOTHING:
        return light[BACKGROUND], light[BACKGROUND + 1], light[BACKGROUND + 2]
    if kind[i] == LAMP:
        return table[i, RADIANCE], table[i, RADIANCE + 1], table[i, RADIANCE + 2]
    gain = table[i, GAIN]
    if kind[i] == SPHERE:
        nx = (x - table[i, CENTRE] - since * table[i, VELOCITY]) / table[i, RADIUS]
        ny = (y - table[i, CENTRE + 1] - since * table[i, VELOCITY + 1]) / table[i, RADIUS]
        nz = (t - table[i, CENTRE + 2] - since * table[i, VELOCITY + 2]) / table[i, RADIUS]
        u = 0.5 + math.atan2(ny, -nz) / (2.0 * math.pi)
        v = math.acos(min(max(nx, -1.0), 1.0)) / math.pi
        facing = nx * light[SUN_DIRECTION] + ny * light[SUN_DIRECTION + 1] + nz * light[SUN_DIRECTION + 2]
        gain = light[SKY] * (0.65 - 0.35 * ny) + light[SUN] * max(facing, 0.0)
    red, green, blue = _bilinear(
        texels, texture[i, 0], texture[i, 1], texture[i, 2], u * table[i, REPEAT_U], v * table[i, REPEAT_V]
    )  # fmt: skip
    return red * gain, green * gain, blue * gain


@njit(cache=True, nogil=True)
def motion_of(table: np.ndarray, i: int, t: float, x: float, y: float, since: float, focal_x: float, focal_y: float) -> tuple[float, float]:
    """Return pixels per shutter of the hit point (x, y, t) in the pinhole picture, a mean from its time to the middle of the exposure.

    (p(t) - p(0.5)) / (t - 0.5) of p = f X / Z is f (V_x Z - V_z X) / (Z Z_middle): the derivative where t = 0.5, and the
    point's place at t = 0.5 follows from it exactly at any time.
    """
    if i == NOTHING:
        return 0.0, 0.0
    vz = table[i, VELOCITY + 2]
    scale = 1.0 / (t * (t - since * vz))
    return focal_x * (table[i, VELOCITY] * t - vz * x) * scale, focal_y * (table[i, VELOCITY + 1] * t - vz * y) * scale


class LensTable(NamedTuple):
    """Uniform points of a pupil from two numbers; see `samples.lens_table`."""

    y: np.ndarray
    x: np.ndarray
    light: np.ndarray


@njit(cache=True, nogil=True)
def lens_point(y: np.ndarray, x: np.ndarray, light: np.ndarray, along: float, across: float) -> tuple[float, float]:
    """Return a point of the pupil: `across` chooses the band and the height in it, `along` the place among its spans, both in [0, 1)."""
    scaled = across * y.shape[0]
    band = min(int(scaled), y.shape[0] - 1)
    k = 1
    while k < x.shape[1] - 1 and light[band, k] <= along:
        k += 1
    share = (along - light[band, k - 1]) / (light[band, k] - light[band, k - 1])
    return x[band, k - 1] + share * (x[band, k] - x[band, k - 1]), y[band, 0] + (scaled - band) * (y[band, 1] - y[band, 0])


@njit(cache=True, nogil=True)
def place(bits: np.uint32) -> float:
    """Return the middle of one of PLACES steps of a pixel's width."""
    return (float(bits >> np.uint32(20)) + 0.5) / PLACES


@njit(cache=True, nogil=True)
def _mixed(x: np.uint32) -> np.uint32:
    x = np.uint32((x ^ (x >> np.uint32(16))) * np.uint32(0x85EBCA6B))
    x = np.uint32((x ^ (x >> np.uint32(13))) * np.uint32(0xC2B2AE35))
    return np.uint32(x ^ (x >> np.uint32(16)))


@njit(cache=True, nogil=True)
def fill_seeds(item: int, first_stream: int, seeds: np.ndarray) -> None:
    """Fill a seed for each pixel (or lamp) and dimension, as `sobol.scramble_seed` gives it."""
    for axis in range(seeds.shape[0]):
        stream = _mixed(np.uint32(first_stream + axis + 0x85EBCA6B))
        seeds[axis] = _mixed(np.uint32(np.uint32(np.uint32(item) * np.uint32(0x9E3779B9)) + stream))


@njit(cache=True, nogil=True)
def scrambled(mirrored_bits: np.uint32, seed: np.uint32) -> np.uint32:
    """Return `sobol.owen_scrambled` of a 32-bit fraction given with its bits in reverse order."""
    x = np.uint32(mirrored_bits + seed)
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x6C50B47C)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0xB82F1E52)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0xC7AFE638)))
    x = np.uint32(x ^ np.uint32(x * np.uint32(0x8D22F6E6)))
    x = np.uint32(((x >> np.uint32(1)) & np.uint32(0x55555555)) | np.uint32((x & np.uint32(0x55555555)) << np.uint32(1)))
    x = np.uint32(((x >> np.uint32(2)) & np.uint32(0x33333333)) | np.uint32((x & np.uint32(0x33333333)) << np.uint32(2)))
    x = np.uint32(((x >> np.uint32(4)) & np.uint32(0x0F0F0F0F)) | np.uint32((x & np.uint32(0x0F0F0F0F)) << np.uint32(4)))
    x = np.uint32(((x >> np.uint32(8)) & np.uint32(0x00FF00FF)) | np.uint32((x & np.uint32(0x00FF00FF)) << np.uint32(8)))
    return np.uint32((x >> np.uint32(16)) | np.uint32(x << np.uint32(16)))
