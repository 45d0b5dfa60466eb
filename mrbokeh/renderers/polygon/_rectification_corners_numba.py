"""Compiled parts of kernel rectification: the pockets between an outline and the corners that touching lines make.

Outlines, `lines` and `places` are those of `polygon._rectification_lines_numba`. swept: (V + 1,) twice the area swept from the origin
along the outline up to each vertex, and once around.
"""

import numpy as np

from mrbokeh.renderers.polygon._outline_geometry_numba import SLACK, cross
from mrbokeh.renderers.polygon._rectification_lines_numba import ARRIVING, FLAT, LEAVING, THROUGH
from mrbokeh.system.kernels import njit


@njit(cache=True)
def _chain(swept: np.ndarray, start: int, stop: int) -> float:
    """Twice the signed area swept from the origin along the outline from place `start` to `stop` (places count on past a turn)."""
    count = swept.shape[0] - 1
    turns = stop // count - start // count
    return swept[stop % count] - swept[start % count] + turns * swept[count]


@njit(cache=True, error_model="numpy")
def _ahead(x: float, y: float, adx: float, ady: float, reach: float, bdx: float, bdy: float, reach_back: float) -> float:
    """How far a line of direction a runs to where it crosses one of direction b through the point (x, y) from its own; -1 if it does
    not, or beyond the reach of either. The hot spot, thus numbers and not arrays.
    """
    turn = cross(adx, ady, bdx, bdy)
    ahead, back = cross(x, y, bdx, bdy), cross(adx, ady, x, y)
    if turn < 0.0:
        turn, ahead, back = -turn, -ahead, -back
    slack = SLACK * turn
    if ahead < -slack or back < -slack or turn <= FLAT or ahead > reach * turn + slack or back > reach_back * turn + slack:
        return -1.0
    return max(ahead / turn, 0.0)


@njit(cache=True)
def _area_or_inf(a: np.ndarray, place_a: int, x: float, y: float, b: np.ndarray, place_b: int, swept: np.ndarray) -> float:
    """The area between the outline and two lines that meet in (x, y); inf where they go around the outline the wrong way."""
    swept_by_lines = cross(a[0], a[1], x, y) + cross(x, y, b[0], b[1])
    area = 0.5 * (swept_by_lines - _chain(swept, place_a, place_b))
    return max(area, 0.0) if area > -SLACK else np.inf


@njit(cache=True)
def _pocket(a: np.ndarray, place_a: np.ndarray, b: np.ndarray, place_b: np.ndarray, swept: np.ndarray) -> float:
    """Area between the outline and the corner where line a is left for line b; inf if they make no corner outside."""
    if place_a[0] == place_b[0]:
        turn = cross(a[2], a[3], b[2], b[3])
        outwards = place_a[1] == THROUGH and place_b[1] == THROUGH and turn > FLAT
        inwards = place_a[1] == ARRIVING and place_b[1] == LEAVING and turn < -FLAT
        return 0.0 if outwards or inwards else np.inf
    ahead = _ahead(b[0] - a[0], b[1] - a[1], a[2], a[3], a[4], b[2], b[3], b[5])
    if ahead < 0.0:
        return np.inf
    return _area_or_inf(a, place_a[0], a[0] + ahead * a[2], a[1] + ahead * a[3], b, place_b[0], swept)


@njit(cache=True)
def corners(lines: np.ndarray, places: np.ndarray, sources: int, span: int, swept: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(starts, targets, areas): for each of the first `sources` lines, all later lines within `span` places that it makes a corner with."""
    total = lines.shape[0]
    starts = np.zeros(sources + 1, np.int64)
    room = max(64, 8 * total)
    targets, areas = np.empty(room, np.int64), np.empty(room)
    size = 0
    for i in range(sources):
        x, y, dx, dy, reach = lines[i, 0], lines[i, 1], lines[i, 2], lines[i, 3], lines[i, 4]
        place = places[i, 0]
        for j in range(i + 1, total):
            if places[j, 0] - place > span:
                break
            if (
                places[j, 0] > place
                and _ahead(lines[j, 0] - x, lines[j, 1] - y, dx, dy, reach, lines[j, 2], lines[j, 3], lines[j, 5]) < 0.0
            ):
                continue
            area = _pocket(lines[i], places[i], lines[j], places[j], swept)
            if area == np.inf:
                continue
            if size == room:
                room *= 2
                targets, areas = _longer(targets, room), _longer(areas, room)
            targets[size], areas[size] = j, area
            size += 1
        starts[i + 1] = size
    return starts, targets[:size].copy(), areas[:size].copy()


@njit(cache=True)
def axis_corners(a: np.ndarray, a_places: np.ndarray, b: np.ndarray, b_places: np.ndarray, swept: np.ndarray) -> np.ndarray:
    """(lines, 2): half the pocket of each line of a with the same line of b, its mirror image beyond the axis: where both make a
    corner (column 0), or are one line across the axis (column 1); inf where they do not.
    """
    areas = np.full((a.shape[0], 2), np.inf)
    for i in range(a.shape[0]):
        if abs(a[i, 2] - b[i, 2]) + abs(a[i, 3] - b[i, 3]) > FLAT:
            areas[i, 0] = 0.5 * _pocket(a[i], a_places[i], b[i], b_places[i], swept)
            continue
        apart = (b[i, 0] - a[i, 0]) * a[i, 2] + (b[i, 1] - a[i, 1]) * a[i, 3]
        if -SLACK <= apart <= a[i, 4] + SLACK:
            areas[i, 1] = 0.5 * _area_or_inf(a[i], a_places[i, 0], b[i, 0], b[i, 1], b[i], b_places[i, 0], swept)
    return areas


@njit(cache=True)
def _longer(values: np.ndarray, room: int) -> np.ndarray:
    grown = np.empty(room, values.dtype)
    grown[: values.size] = values
    return grown
