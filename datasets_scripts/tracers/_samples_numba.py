"""Compiled loops of the stochastic sampler: rays through a film point, a lens point and a moment, 8 rows of a picture at a time.

Every pixel draws its own scrambled points, so that neither threads nor the order of the rows change a bit. Small lamps, which
such rays would seldom find, are sampled on themselves. Film point p, lens point o and lamp point x at depth z determine each other
two by two, x = z p + o (1 - z / d_f): a lamp that is much blurred is gathered by every pixel that it reaches, one near the focus
is followed to the film.
"""

import math
from typing import NamedTuple

import numpy as np

from datasets_scripts.tracers._moving_bodies_numba import (
    CENTRE,
    DIMENSIONS,
    LAMP,
    PER_BIT,
    RADIANCE,
    RADIUS,
    VELOCITY,
    LensTable,
    PackedBodies,
    fill_seeds,
    first_hit,
    lens_point,
    motion_of,
    place,
    radiance_of,
    scrambled,
)
from mrbokeh.system.kernels import njit

TILE_PX = 8
OWN_LAMP = 1.0 - 1e-9


class Pinhole(NamedTuple):
    """The middle of the lens: size and focal length of the picture in pixels; pupil radius in metres and 1 / focus distance."""

    width: int
    height: int
    focal: float
    pupil_radius: float
    inverse_focus: float


@njit(cache=True, nogil=True)
def members_of_tile(bounds_px: np.ndarray, left: int, top: int, members: np.ndarray) -> int:
    """Fill `members` with the bodies whose blur can touch a tile, and count them."""
    count = 0
    for i in range(bounds_px.shape[0]):
        overlaps_x = bounds_px[i, 0] <= left + TILE_PX and bounds_px[i, 2] >= left
        if overlaps_x and bounds_px[i, 1] <= top + TILE_PX and bounds_px[i, 3] >= top:
            members[count] = i
            count += 1
    return count


@njit(cache=True, nogil=True)
def sample_rows(
    s: PackedBodies,
    view: Pinhole,
    lens: LensTable,
    mirrored: np.ndarray,
    first_stream: int,
    top: int,
    filled: tuple,
) -> None:
    """Fill arrays (H, W, spp, ...) from row `top` on: one ray per sample, each with its own film point, lens point and moment.

    filled: xy_px, lens_uv, time, rgb, depth_m, motion_px.
    """
    xy_px, lens_uv, time, rgb, depth_m, motion_px = filled
    table, kind, bounds_px = s.table, s.kind, s.bounds_px
    lens_y, lens_x, lens_light = lens.y, lens.x, lens.light
    members, seeds = np.empty(table.shape[0], np.int64), np.empty(DIMENSIONS, np.uint32)
    for left in range(0, view.width, TILE_PX):
        count = members_of_tile(bounds_px, left, top, members)
        for row in range(top, min(top + TILE_PX, view.height)):
            for column in range(left, min(left + TILE_PX, view.width)):
                fill_seeds(row * view.width + column, first_stream, seeds)
                for n in range(mirrored.shape[0]):
                    px = column + place(scrambled(mirrored[n, 0], seeds[0]))
                    py = row + place(scrambled(mirrored[n, 1], seeds[1]))
                    along, across = scrambled(mirrored[n, 2], seeds[2]) * PER_BIT, scrambled(mirrored[n, 3], seeds[3]) * PER_BIT
                    u, v = lens_point(lens_y, lens_x, lens_light, along, across)
                    moment = scrambled(mirrored[n, 4], seeds[4]) * PER_BIT
                    ox, oy = u * view.pupil_radius, v * view.pupil_radius
                    dx = (px - 0.5 * view.width) / view.focal - ox * view.inverse_focus
                    dy = (py - 0.5 * view.height) / view.focal - oy * view.inverse_focus
                    i, t, edge_u, edge_v = first_hit(table, kind, members, count, ox, oy, dx, dy, moment - 0.5)
                    x, y = ox + t * dx, oy + t * dy
                    red, green, blue = radiance_of(s, i, t, edge_u, edge_v, x, y, moment - 0.5)
                    mx, my = motion_of(table, i, t, x, y, moment - 0.5, view.focal, view.focal)
                    xy_px[row, column, n, 0], xy_px[row, column, n, 1] = px, py
                    lens_uv[row, column, n, 0], lens_uv[row, column, n, 1] = u, v
                    time[row, column, n], depth_m[row, column, n] = moment, t
                    rgb[row, column, n, 0], rgb[row, column, n, 1], rgb[row, column, n, 2] = red, green, blue
                    motion_px[row, column, n, 0], motion_px[row, column, n, 1] = mx, my


@njit(cache=True, nogil=True)
def mean_rows(s: PackedBodies, view: Pinhole, lens: LensTable, mirrored: np.ndarray, first_stream: int, top: int, rgb: np.ndarray) -> None:
    """Fill rgb (H, W, 3) from row `top` on with the mean over each pixel's square, the pupil and the shutter; lamps are black."""
    table, kind, bounds_px = s.table, s.kind, s.bounds_px
    lens_y, lens_x, lens_light = lens.y, lens.x, lens.light
    members, seeds = np.empty(table.shape[0], np.int64), np.empty(DIMENSIONS, np.uint32)
    samples = mirrored.shape[0]
    for left in range(0, view.width, TILE_PX):
        count = members_of_tile(bounds_px, left, top, members)
        for row in range(top, min(top + TILE_PX, view.height)):
            for column in range(left, min(left + TILE_PX, view.width)):
                fill_seeds(row * view.width + column, first_stream, seeds)
                red, green, blue = 0.0, 0.0, 0.0
                for n in range(samples):
                    px = column + place(scrambled(mirrored[n, 0], seeds[0]))
                    py = row + place(scrambled(mirrored[n, 1], seeds[1]))
                    along, across = scrambled(mirrored[n, 2], seeds[2]) * PER_BIT, scrambled(mirrored[n, 3], seeds[3]) * PER_BIT
                    u, v = lens_point(lens_y, lens_x, lens_light, along, across)
                    since = scrambled(mirrored[n, 4], seeds[4]) * PER_BIT - 0.5
                    ox, oy = u * view.pupil_radius, v * view.pupil_radius
                    dx = (px - 0.5 * view.width) / view.focal - ox * view.inverse_focus
                    dy = (py - 0.5 * view.height) / view.focal - oy * view.inverse_focus
                    i, t, edge_u, edge_v = first_hit(table, kind, members, count, ox, oy, dx, dy, since)
                    if i >= 0 and kind[i] == LAMP:
                        continue
                    r, g, b = radiance_of(s, i, t, edge_u, edge_v, ox + t * dx, oy + t * dy, since)
                    red, green, blue = red + r, green + g, blue + b
                rgb[row, column, 0], rgb[row, column, 1], rgb[row, column, 2] = red / samples, green / samples, blue / samples


@njit(cache=True, nogil=True)
def sharp_rows(
    s: PackedBodies,
    view: Pinhole,
    mirrored: np.ndarray,
    first_stream: int,
    top: int,
    rgba: np.ndarray,
    depth_m: np.ndarray,
    motion_px: np.ndarray,
) -> None:
    """Add to rgba (H, W, 4) and fill depth and motion from row `top` on: the pinhole picture in the middle of the exposure.

    Depth and motion are those of the hit nearest to the pixel's centre, or of the lamps' where lamps give over half the light.
    """
    table, kind, bounds_px = s.table, s.kind, s.bounds_px
    members, seeds = np.empty(table.shape[0], np.int64), np.empty(DIMENSIONS, np.uint32)
    sums, nearest, found = np.empty(2), np.empty(2), np.empty((2, 3))
    for left in range(0, view.width, TILE_PX):
        count = members_of_tile(bounds_px, left, top, members)
        for row in range(top, min(top + TILE_PX, view.height)):
            for column in range(left, min(left + TILE_PX, view.width)):
                fill_seeds(row * view.width + column, first_stream, seeds)
                sums[:], nearest[:] = 0.0, math.inf
                for n in range(-1, mirrored.shape[0]):
                    px, py, share = column + 0.5, row + 0.5, 0.0
                    if n >= 0:
                        px = column + place(scrambled(mirrored[n, 0], seeds[0]))
                        py = row + place(scrambled(mirrored[n, 1], seeds[1]))
                        share = 1.0 / mirrored.shape[0]
                    dx, dy = (px - 0.5 * view.width) / view.focal, (py - 0.5 * view.height) / view.focal
                    i, t, edge_u, edge_v = first_hit(table, kind, members, count, 0.0, 0.0, dx, dy, 0.0)
                    r, g, b = radiance_of(s, i, t, edge_u, edge_v, t * dx, t * dy, 0.0)
                    rgba[row, column, 0] += share * r
                    rgba[row, column, 1] += share * g
                    rgba[row, column, 2] += share * b
                    if i < 0:
                        continue
                    rgba[row, column, 3] += share
                    of = 1 if kind[i] == LAMP else 0
                    sums[of] += share * (r + g + b)
                    away = (px - column - 0.5) ** 2 + (py - row - 0.5) ** 2
                    if away < nearest[of]:
                        nearest[of], found[of, 0] = away, t
                        found[of, 1], found[of, 2] = motion_of(table, i, t, t * dx, t * dy, 0.0, view.focal, view.focal)
                of = 1 if sums[1] > sums[0] else 0
                alpha = rgba[row, column, 3]
                if alpha > 0.0:
                    of = of if nearest[of] < math.inf else 1 - of
                    depth_m[row, column] = found[of, 0]
                    motion_px[row, column, 0], motion_px[row, column, 1] = found[of, 1] * alpha, found[of, 2] * alpha
                else:
                    depth_m[row, column], motion_px[row, column, 0], motion_px[row, column, 1] = math.inf, 0.0, 0.0


@njit(cache=True, nogil=True)
def _transmission(vertices: np.ndarray, starts: np.ndarray, weights: np.ndarray, x: float, y: float) -> float:
    """Return the weighted sum of the outlines that hold the lens point (even-odd rule)."""
    total = 0.0
    for k in range(weights.shape[0]):
        inside = False
        j = starts[k + 1] - 1
        for i in range(starts[k], starts[k + 1]):
            crosses = (vertices[i, 1] > y) != (vertices[j, 1] > y)
            if crosses and x < vertices[i, 0] + (vertices[j, 0] - vertices[i, 0]) * (y - vertices[i, 1]) / (
                vertices[j, 1] - vertices[i, 1]
            ):
                inside = not inside
            j = i
        total += weights[k] if inside else 0.0
    return total


@njit(cache=True, nogil=True)
def _lamp_point(table: np.ndarray, lamp: int, first: np.uint32, second: np.uint32, since: float) -> tuple[float, float, float]:
    radius, angle = table[lamp, RADIUS] * math.sqrt(first * PER_BIT), 2.0 * math.pi * second * PER_BIT
    x = table[lamp, CENTRE] + since * table[lamp, VELOCITY] + radius * math.cos(angle)
    y = table[lamp, CENTRE + 1] + since * table[lamp, VELOCITY + 1] + radius * math.sin(angle)
    return x, y, table[lamp, CENTRE + 2] + since * table[lamp, VELOCITY + 2]


@njit(cache=True, nogil=True)
def gather_rows(
    s: PackedBodies,
    view: Pinhole,
    outlines: tuple,
    pupil_area: float,
    gathered: np.ndarray,
    mirrored: np.ndarray,
    first_stream: int,
    top: int,
    rgb: np.ndarray,
) -> None:
    """Add to rgb (H, W, 3) from row `top` on the light of the lamps of which `gathered` (bodies,) is true.

    outlines: vertices, starts and weights of the pupil.
    With p and t fixed, an area on the lamp is one on the pupil over (R (1 - z / d_f))^2.
    """
    vertices, starts, weights = outlines
    table, kind, bounds_px = s.table, s.kind, s.bounds_px
    members, seeds = np.empty(table.shape[0], np.int64), np.empty(DIMENSIONS, np.uint32)
    for left in range(0, view.width, TILE_PX):
        count = members_of_tile(bounds_px, left, top, members)
        for m in range(count):
            lamp = members[m]
            if not gathered[lamp]:
                continue
            for row in range(top, min(top + TILE_PX, view.height)):
                for column in range(left, min(left + TILE_PX, view.width)):
                    fill_seeds(row * view.width + column, first_stream, seeds)
                    total = 0.0
                    for n in range(mirrored.shape[0]):
                        since = scrambled(mirrored[n, 4], seeds[4]) * PER_BIT - 0.5
                        first, second = scrambled(mirrored[n, 2], seeds[2]), scrambled(mirrored[n, 3], seeds[3])
                        x, y, z = _lamp_point(table, lamp, first, second, since)
                        slope_x = (column + place(scrambled(mirrored[n, 0], seeds[0])) - 0.5 * view.width) / view.focal
                        slope_y = (row + place(scrambled(mirrored[n, 1], seeds[1])) - 0.5 * view.height) / view.focal
                        on_lamp = (1.0 - z * view.inverse_focus) * view.pupil_radius
                        u, v = (x - slope_x * z) / on_lamp, (y - slope_y * z) / on_lamp
                        open_share = _transmission(vertices, starts, weights, u, v)
                        if open_share == 0.0:
                            continue
                        ox, oy = u * view.pupil_radius, v * view.pupil_radius
                        dx, dy = slope_x - ox * view.inverse_focus, slope_y - oy * view.inverse_focus
                        i, t, _, _ = first_hit(table, kind, members, count, ox, oy, dx, dy, since)
                        if i == lamp or t > z * OWN_LAMP:
                            total += open_share / on_lamp**2
                    share = total * math.pi * table[lamp, RADIUS] ** 2 / (pupil_area * mirrored.shape[0])
                    for c in range(3):
                        rgb[row, column, c] += share * table[lamp, RADIANCE + c]


@njit(cache=True, nogil=True)
def follow_lamp(
    s: PackedBodies,
    view: Pinhole,
    lens: LensTable,
    lamp: int,
    mirrored: np.ndarray,
    first_stream: int,
    left: int,
    top: int,
    light: np.ndarray,
) -> None:
    """Add to light (h, w), a window from (left, top) of the picture, each pixel's share of a lamp of radiance 1.

    Lamp point, lens point and moment are drawn evenly; with lens point and moment fixed, an area on the lamp is one on the film
    times (f / z)^2. Bodies that could hide the lamp are those whose bounds meet its own.
    """
    table, kind, bounds_px = s.table, s.kind, s.bounds_px
    lens_y, lens_x, lens_light = lens.y, lens.x, lens.light
    members, seeds, count = np.empty(table.shape[0], np.int64), np.empty(DIMENSIONS, np.uint32), 0
    for i in range(bounds_px.shape[0]):
        apart_x = bounds_px[i, 0] > bounds_px[lamp, 2] or bounds_px[i, 2] < bounds_px[lamp, 0]
        if not (apart_x or bounds_px[i, 1] > bounds_px[lamp, 3] or bounds_px[i, 3] < bounds_px[lamp, 1]):
            members[count] = i
            count += 1
    fill_seeds(lamp, first_stream, seeds)
    for n in range(mirrored.shape[0]):
        since = scrambled(mirrored[n, 4], seeds[4]) * PER_BIT - 0.5
        x, y, z = _lamp_point(table, lamp, scrambled(mirrored[n, 0], seeds[0]), scrambled(mirrored[n, 1], seeds[1]), since)
        along, across = scrambled(mirrored[n, 2], seeds[2]) * PER_BIT, scrambled(mirrored[n, 3], seeds[3]) * PER_BIT
        u, v = lens_point(lens_y, lens_x, lens_light, along, across)
        ox, oy = u * view.pupil_radius, v * view.pupil_radius
        dx, dy = (x - ox) / z, (y - oy) / z
        px = 0.5 * view.width + view.focal * (dx + ox * view.inverse_focus)
        py = 0.5 * view.height + view.focal * (dy + oy * view.inverse_focus)
        column, row = int(math.floor(px)) - left, int(math.floor(py)) - top
        if column < 0 or row < 0 or column >= light.shape[1] or row >= light.shape[0]:
            continue
        i, t, _, _ = first_hit(table, kind, members, count, ox, oy, dx, dy, since)
        if i == lamp or t > z * OWN_LAMP:
            light[row, column] += math.pi * (table[lamp, RADIUS] * view.focal / z) ** 2 / mirrored.shape[0]
