"""The smallest polygon around an outline, by the cheapest walks over lines that touch it (see `mrbokeh.renderers.polygon.rectification`).

Shapes here are centred, turn with positive area and reach 1 from their middle.
"""

import numpy as np

from mrbokeh.renderers.polygon.outline_geometry import EXACT, Outline, area, corner_points, swept_areas, without_flat_vertices
from mrbokeh.renderers.polygon.outline_symmetry import NO_SYMMETRY, Sector, sectors


def smallest_polygon(shape: Outline, steps: Outline, max_edges: int, symmetry_cost: float) -> Outline | None:
    """The smallest polygon of the largest symmetry that is not too dear; None where nothing closes."""
    plain = _simple_walk(Sector(shape, len(shape), NO_SYMMETRY, (np.eye(2),)), shape, steps, max_edges)
    if plain is None or symmetry_cost < 0.0:
        return plain
    for sector in sectors(shape, steps):
        polygon = _simple_walk(sector, shape, steps, max_edges)
        if polygon is not None and area(polygon) <= area(plain) + symmetry_cost * area(shape) + EXACT:
            return polygon
    return plain


def _simple_walk(sector: Sector, shape: Outline, steps: Outline, max_edges: int) -> Outline | None:
    """The smallest polygon around `shape` of the sector's symmetry that does not cross itself.

    Where two corners on either side of a narrow gap overlap, the smallest walk crosses itself; then fewer edges are tried,
    which closes the gap. Only then the result may fail to be the smallest.
    """
    while max_edges >= 3:
        lines = (_turned_walk if sector.symmetry.axis is None else _mirrored_walk)(sector, steps, max_edges // sector.symmetry.turns)
        if len(lines) < 3:
            return None
        polygon = _enclosing(lines, shape)
        if not _overlaps_itself(polygon):
            return polygon
        max_edges = len(lines) - 1
    return None


def _overlaps_itself(polygon: Outline) -> bool:
    """Whether a polygon crosses itself. Made a little smaller first: then one that touches itself in a point does not."""
    from mrbokeh.renderers.polygon._outline_geometry_numba import crosses_itself

    edges = np.roll(polygon, -1, axis=0) - polygon
    return bool(crosses_itself(corner_points(np.column_stack([polygon, edges / np.hypot(*edges.T)[:, None]]), -1e3 * EXACT)))


def _enclosing(lines: np.ndarray, shape: Outline) -> Outline:
    """The polygon of lines in their order, all moved outwards by as much as the shape differs from its symmetric twin."""
    from mrbokeh.renderers.polygon._outline_geometry_numba import farthest_from_outline

    outwards, polygon = 0.0, without_flat_vertices(corner_points(lines, 0.0))
    for _ in range(8):
        missing = max(farthest_from_outline(shape, polygon, 1), farthest_from_outline(polygon, shape, -1))
        if missing <= EXACT:
            break
        outwards += missing
        polygon = without_flat_vertices(corner_points(lines, outwards))
    return polygon


def _turned_walk(sector: Sector, steps: Outline, most: int) -> np.ndarray:
    """Lines (x, y, dx, dy) of the smallest polygon, with `most` of them in each of the turned parts."""
    from mrbokeh.renderers.polygon import _rectification_corners_numba as pockets
    from mrbokeh.renderers.polygon import _rectification_walks_numba as walks
    from mrbokeh.renderers.polygon._rectification_lines_numba import touching_lines

    lines, places = touching_lines(sector.outline, 0, sector.size - 1, steps)
    turn, count = sector.to_image[0], len(lines)
    next_period = places + np.array([sector.size, 0])
    lines, places = np.concatenate([lines, _turned(lines, turn)]), np.concatenate([places, next_period])
    starts, targets, areas = pockets.corners(lines, places, count, sector.size, swept_areas(sector.outline))
    walk = walks.cheapest_turn(count, _fewest_origins(starts, targets), starts, targets, areas, most)
    return np.concatenate([_turned(lines[walk, :4], np.linalg.matrix_power(turn, i)) for i in range(sector.symmetry.turns)])


def _fewest_origins(starts: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Lines of which every closed walk contains one: those with a corner across one cut of the outline, for the best cut."""
    count = len(starts) - 1
    line = np.flatnonzero(np.diff(starts))
    farthest = targets[starts[line + 1] - 1]
    change = np.zeros(2 * count + 1, np.int64)
    np.add.at(change, line, 1)
    np.add.at(change, farthest, -1)
    across = change.cumsum()[: 2 * count].reshape(2, count).sum(axis=0)
    cut = int(across.argmin())
    return line[((line <= cut) & (cut < farthest)) | (cut + count < farthest)]


def _mirrored_walk(sector: Sector, steps: Outline, most: int) -> np.ndarray:
    """Lines (x, y, dx, dy) of the smallest polygon, with `most` of them in each pair of mirrored sectors."""
    from mrbokeh.renderers.polygon import _rectification_corners_numba as pockets
    from mrbokeh.renderers.polygon import _rectification_walks_numba as walks
    from mrbokeh.renderers.polygon._rectification_lines_numba import touching_lines

    lines, places = touching_lines(sector.outline, 0, sector.size, steps)
    swept, (first, second) = swept_areas(sector.outline), sector.to_image
    starts, targets, areas = pockets.corners(lines, places, len(lines), sector.size, swept)
    before, beyond = _mirrored(lines, first), _mirrored(lines, second)
    places_before, places_beyond = _mirrored_places(places, 0), _mirrored_places(places, sector.size)
    at_first = pockets.axis_corners(before, places_before, lines, places, swept)
    at_second = pockets.axis_corners(lines, places, beyond, places_beyond, swept)
    walk = walks.cheapest_sector(at_first, at_second, starts, targets, areas, most)
    if len(walk) == 0:
        return np.empty((0, 4))
    back = beyond[walk[::-1], :4]
    starts_across, ends_across = at_first[walk[0], 1] < np.inf, at_second[walk[-1], 1] < np.inf
    period = np.concatenate([lines[walk, :4], back[int(ends_across) : len(back) - int(starts_across)]])
    return np.concatenate([_turned(period, np.linalg.matrix_power(second @ first, i)) for i in range(sector.symmetry.turns)])


def _mirrored(lines: np.ndarray, mirror: np.ndarray) -> np.ndarray:
    """The mirror images of lines (x, y, dx, dy, forward, backward), with the outline to their left as before."""
    return np.column_stack([lines[:, :2] @ mirror.T, -lines[:, 2:4] @ mirror.T, lines[:, [5, 4]]])


def _mirrored_places(places: np.ndarray, axis: int) -> np.ndarray:
    """Places (place, kind) of the mirror images, where the axis lies at place `axis`: what arrives leaves, and the other way round."""
    from mrbokeh.renderers.polygon._rectification_lines_numba import ARRIVING, LEAVING, THROUGH

    kinds = places[:, 1]
    return np.column_stack([2 * axis - places[:, 0], np.where(kinds == THROUGH, THROUGH, ARRIVING + LEAVING - kinds)])


def _turned(lines: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return np.column_stack([lines[:, :2] @ turn.T, lines[:, 2:4] @ turn.T, lines[:, 4:]])
