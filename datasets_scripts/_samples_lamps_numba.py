"""Compiled light of small lamps, which rays through the lens would seldom find: from points on the lamp, in two ways.

Film point p, lens point o and lamp point x at depth z determine each other two by two, x = z p + o (1 - z / d_f): a lamp that is
much blurred is gathered by every pixel that it reaches, one near the focus is followed to the film.
"""

import math

import numpy as np

from datasets_scripts._samples_bodies_numba import CENTRE, RADIANCE, RADIUS, VELOCITY, PackedBodies, first_hit
from datasets_scripts._samples_numba import TILE_PX, Pinhole, members_of_tile
from datasets_scripts._samples_random_numba import DIMENSIONS, PER_BIT, LensTable, fill_seeds, lens_point, place, scrambled
from mrbokeh.system.kernels import njit

OWN_LAMP = 1.0 - 1e-9


@njit(cache=True, nogil=True)
def _transmission(vertices: np.ndarray, starts: np.ndarray, weights: np.ndarray, x: float, y: float) -> float:
    """The weighted sum of the outlines that hold the lens point (even-odd rule)."""
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
    vertices: np.ndarray,
    starts: np.ndarray,
    weights: np.ndarray,
    pupil_area: float,
    gathered: np.ndarray,
    mirrored: np.ndarray,
    first_stream: int,
    top: int,
    rgb: np.ndarray,
) -> None:
    """Add to rgb (H, W, 3) from row `top` on the light of the lamps of which `gathered` (bodies,) is true.

    With p and t fixed, an area on the lamp is one on the pupil over (R (1 - z / d_f))^2.
    """
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
