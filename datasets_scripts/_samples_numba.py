"""Compiled loops of the stochastic sampler: rays through a film point, a lens point and a moment, over 8 rows of a picture at a time.

Every pixel draws its own scrambled points, so that neither threads nor the order of the rows change a bit.
"""

import math
from typing import NamedTuple

import numpy as np

from datasets_scripts._samples_bodies_numba import LAMP, PackedBodies, first_hit, motion_of, radiance_of
from datasets_scripts._samples_random_numba import DIMENSIONS, PER_BIT, LensTable, fill_seeds, lens_point, place, scrambled
from mrbokeh.system.kernels import njit

TILE_PX = 8


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
    xy_px: np.ndarray,
    lens_uv: np.ndarray,
    time: np.ndarray,
    rgb: np.ndarray,
    depth_m: np.ndarray,
    motion_px: np.ndarray,
) -> None:
    """Fill (H, W, spp, ...) arrays from row `top` on: one ray per sample, each with its own film point, lens point and moment."""
    table, kind, bounds_px, texture, texels, light = s.table, s.kind, s.bounds_px, s.texture, s.texels, s.light
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
                    red, green, blue = radiance_of(table, kind, texture, texels, light, i, t, edge_u, edge_v, x, y, moment - 0.5)
                    mx, my = motion_of(table, i, t, x, y, moment - 0.5, view.focal, view.focal)
                    xy_px[row, column, n, 0], xy_px[row, column, n, 1] = px, py
                    lens_uv[row, column, n, 0], lens_uv[row, column, n, 1] = u, v
                    time[row, column, n], depth_m[row, column, n] = moment, t
                    rgb[row, column, n, 0], rgb[row, column, n, 1], rgb[row, column, n, 2] = red, green, blue
                    motion_px[row, column, n, 0], motion_px[row, column, n, 1] = mx, my


@njit(cache=True, nogil=True)
def mean_rows(s: PackedBodies, view: Pinhole, lens: LensTable, mirrored: np.ndarray, first_stream: int, top: int, rgb: np.ndarray) -> None:
    """Fill rgb (H, W, 3) from row `top` on with the mean over each pixel's square, the pupil and the shutter; lamps are black."""
    table, kind, bounds_px, texture, texels, light = s.table, s.kind, s.bounds_px, s.texture, s.texels, s.light
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
                    r, g, b = radiance_of(table, kind, texture, texels, light, i, t, edge_u, edge_v, ox + t * dx, oy + t * dy, since)
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
    table, kind, bounds_px, texture, texels, light = s.table, s.kind, s.bounds_px, s.texture, s.texels, s.light
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
                    r, g, b = radiance_of(table, kind, texture, texels, light, i, t, edge_u, edge_v, t * dx, t * dy, 0.0)
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
