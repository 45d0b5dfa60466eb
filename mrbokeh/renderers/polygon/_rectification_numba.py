"""Compiled kernel rectification: lines that touch an outline, the pockets at their corners, and the cheapest walks around it.

Outlines here are closed, (V, 2), of unit size, do not cross themselves and turn with positive area, so that the inside
lies to the left of every edge. A line is a row (x, y, dx, dy, forward, backward) of `lines`: a vertex that it touches,
its unit direction with the outline to the left, and how far it runs from the vertex, either way, before it enters the
outline. The matching row of `places` is (index of the vertex, kind). swept: (V + 1,) twice the area swept from the origin
along the outline up to each vertex, and once around. starts, targets, areas: the arcs of walks, line after line, as `corners` gives them.
"""

import math

import numpy as np

from mrbokeh.system.compiled import njit

ALIKE = 1e-12
"""Areas closer than this are the same; of such walks the one with fewer lines is taken."""


@njit(cache=True)
def _still_to_pay(period: int, origins: np.ndarray, starts: np.ndarray, targets: np.ndarray, areas: np.ndarray, most: int) -> np.ndarray:
    """Return (most + 1, 2 period): the least that a walk costs from each line to the image of any origin, with at most so many more
    lines.
    """
    least = np.full((most + 1, 2 * period), np.inf)
    for origin in origins:
        least[:, origin + period] = 0.0
    for n in range(1, most + 1):
        for line in range(2 * period - 1, -1, -1):
            base, shift = line % period, line - line % period
            price = min(least[n, line], least[n - 1, line])
            for k in range(starts[base], starts[base + 1]):
                if targets[k] + shift >= 2 * period:
                    break
                price = min(price, areas[k] + least[n - 1, targets[k] + shift])
            least[n, line] = price
    return least


@njit(cache=True)
def cheapest_turn(period: int, origins: np.ndarray, starts: np.ndarray, targets: np.ndarray, areas: np.ndarray, most: int) -> np.ndarray:
    """Return the lines of the cheapest walk from one of `origins` to its image one period later, of at most `most` lines; empty if none.

    Lines 0..period-1 are one period of the outline, period..2 period-1 the next. Walks that cannot become cheaper than the
    best one so far, even if they might end at any origin, are given up; that leaves little to do after the first origin.
    """
    best, found = np.inf, np.empty(0, np.int64)
    least = _still_to_pay(period, origins, starts, targets, areas, most)
    cost, source = np.empty((most + 1, 2 * period)), np.empty((most + 1, 2 * period), np.int64)
    for origin in origins[_in_order(least[most][origins])]:
        if least[most, origin] >= best - ALIKE:
            break
        cost[:] = np.inf
        cost[0, origin] = 0.0
        for line in range(origin, origin + period):
            base, shift = line % period, line - line % period
            for n in range(most):
                if cost[n, line] + least[most - n, line] >= best - ALIKE:
                    continue
                for k in range(starts[base], starts[base + 1]):
                    target, price = targets[k] + shift, cost[n, line] + areas[k]
                    if target > origin + period:
                        break
                    if price < cost[n + 1, target]:
                        cost[n + 1, target], source[n + 1, target] = price, line
        for n in range(1, most + 1):
            if cost[n, origin + period] < best - ALIKE:
                best = cost[n, origin + period]
                found = _walk_back(source, n, origin + period, 0)
    return found


@njit(cache=True)
def cheapest_sector(
    first: np.ndarray, last: np.ndarray, starts: np.ndarray, targets: np.ndarray, areas: np.ndarray, most: int
) -> np.ndarray:
    """Return the lines of the cheapest walk from one mirror axis to the next; empty if none has at most `most` lines with its mirror image.

    first, last: (lines, 2), what a line costs as the first or last one where it makes a corner with its own image on the axis
    (column 0) or is its own image (column 1); inf where it cannot.
    """
    total = first.shape[0]
    cost, source = np.full((most + 2, total), np.inf), np.full((most + 2, total), -1, np.int64)
    for line in range(total):
        cost[1, line], cost[2, line] = first[line, 1], first[line, 0]
    best, found = np.inf, np.empty(0, np.int64)
    for line in range(total):
        for n in range(1, most):
            if cost[n, line] == np.inf:
                continue
            for k in range(starts[line], starts[line + 1]):
                target, price = targets[k], cost[n, line] + areas[k]
                if n + 2 <= most + 1 and price < cost[n + 2, target]:
                    cost[n + 2, target], source[n + 2, target] = price, line
    for used in range(1, most + 1):
        for line in range(total):
            for own in range(2):
                if cost[used + own, line] + last[line, own] < best - ALIKE:
                    best = cost[used + own, line] + last[line, own]
                    found = _walk_back(source, used + own, line, -1)
    return found


@njit(cache=True)
def _walk_back(source: np.ndarray, n: int, line: int, stop: int) -> np.ndarray:
    """Follow `source` back to the start of the walk: by one per line to n = stop, or by two where stop is -1."""
    walk = np.empty(n + 1, np.int64)
    size = 0
    while n > 0 if stop == 0 else line >= 0:
        if stop == 0:
            line = source[n, line]
            n -= 1
            walk[size] = line
        else:
            walk[size] = line
            line = source[n, line]
            n -= 2
        size += 1
    return walk[:size][::-1].copy()


SLACK = 1e-8
"""Lengths up to this are rounding: a point so near a line is on it, one so far beyond a reach still within."""


@njit(cache=True)
def cross(ax: float, ay: float, bx: float, by: float) -> float:
    return ax * by - ay * bx


@njit(cache=True)
def crosses_itself(outline: np.ndarray) -> bool:
    """Return whether two edges that are no neighbours cross or overlap by more than rounding."""
    count = outline.shape[0]
    for i in range(count):
        a, b = outline[i], outline[(i + 1) % count]
        for j in range(i + 2, count - (1 if i == 0 else 0)):
            c, d = outline[j], outline[(j + 1) % count]
            c_side, d_side = _side(a, b, c), _side(a, b, d)
            a_side, b_side = _side(c, d, a), _side(c, d, b)
            if c_side * d_side < 0.0 and a_side * b_side < 0.0:
                return True
    return False


@njit(cache=True)
def _side(a: np.ndarray, b: np.ndarray, point: np.ndarray) -> float:
    """Return the distance of a point to the left of the line from a to b; 0 where it is within rounding of the line."""
    x, y = b[0] - a[0], b[1] - a[1]
    distance = cross(x, y, point[0] - a[0], point[1] - a[1]) / math.hypot(x, y)
    return 0.0 if abs(distance) < SLACK else distance


@njit(cache=True)
def farthest_from_outline(points: np.ndarray, outline: np.ndarray, side: int) -> float:
    """Return the largest distance of a point from the closed outline, among all points (side 0), those outside (1) or those inside
    (-1).
    """
    farthest, count = 0.0, outline.shape[0]
    for i in range(points.shape[0]):
        x, y = points[i]
        nearest, inside = np.inf, False
        for j in range(count):
            k = j + 1 if j + 1 < count else 0
            ax, ay = outline[j, 0] - x, outline[j, 1] - y
            bx, by = outline[k, 0] - x, outline[k, 1] - y
            share = -(ax * (bx - ax) + ay * (by - ay)) / ((bx - ax) ** 2 + (by - ay) ** 2)
            share = min(max(share, 0.0), 1.0)
            nearest = min(nearest, (ax + share * (bx - ax)) ** 2 + (ay + share * (by - ay)) ** 2)
            if (ay > 0.0) != (by > 0.0) and (ax * by - bx * ay > 0.0) == (by > ay):
                inside = not inside
        if side == 0 or inside == (side < 0):
            farthest = max(farthest, nearest)
    return math.sqrt(farthest)


THROUGH, ARRIVING, LEAVING = 0, 1, 2
"""Kinds of line: touching on both sides of the vertex; ending or starting at a vertex that points inwards."""

ASIDE = 1e-10
"""Rays run this far to the right of their line: what touches the line from the left does not stop them."""

FLAT = 1e-11
"""Sines below this are a straight angle."""


@njit(cache=True)
def _kind(inwards: np.ndarray, outwards: np.ndarray, dx: float, dy: float) -> int:
    """Return how a line of direction (dx, dy) touches the vertex between two unit edges, or -1 if it enters the outline."""
    turn = cross(inwards[0], inwards[1], outwards[0], outwards[1])
    from_in = cross(inwards[0], inwards[1], dx, dy)
    to_out = cross(dx, dy, outwards[0], outwards[1])
    if turn >= -FLAT:
        ahead = dx * (inwards[0] + outwards[0]) + dy * (inwards[1] + outwards[1]) > 0.0
        return THROUGH if from_in >= -FLAT and to_out >= -FLAT and ahead else -1
    if from_in < -FLAT and to_out >= -FLAT:
        return LEAVING
    if to_out < -FLAT and from_in >= -FLAT:
        return ARRIVING
    return -1


@njit(cache=True)
def _reach(outline: np.ndarray, vertex: int, dx: float, dy: float, sense: float) -> float:
    """Return how far the line through a vertex runs, ahead (sense 1) or back (-1), until it meets an edge that is not the vertex's own."""
    count = outline.shape[0]
    x, y = outline[vertex, 0] + ASIDE * dy, outline[vertex, 1] - ASIDE * dx
    before = (vertex - 1) % count
    nearest = np.inf
    for i in range(count):
        if i in (vertex, before):
            continue
        j = i + 1 if i + 1 < count else 0
        ax, ay = outline[i, 0] - x, outline[i, 1] - y
        bx, by = outline[j, 0] - x, outline[j, 1] - y
        side_a, side_b = cross(dx, dy, ax, ay), cross(dx, dy, bx, by)
        if (side_a > 0.0) == (side_b > 0.0):
            continue
        share = side_a / (side_a - side_b)
        along = sense * (dx * (ax + share * (bx - ax)) + dy * (ay + share * (by - ay)))
        if along >= 0.0:
            nearest = min(nearest, along)
    return nearest


@njit(cache=True)
def touching_lines(outline: np.ndarray, first: int, last: int, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return (lines, places) of all lines along `directions` (unit, both senses) that touch the vertices first..last from outside.

    Ordered along the outline; at a vertex that points outwards by direction, at one that points inwards arriving lines first.
    """
    count, most = outline.shape[0], (last - first + 1) * directions.shape[0]
    lines, places, size = np.empty((most, 6)), np.empty((most, 2), np.int64), 0
    order = np.empty(directions.shape[0])
    for place in range(first, last + 1):
        vertex = place % count
        inwards = outline[vertex] - outline[(vertex - 1) % count]
        outwards = outline[(vertex + 1) % count] - outline[vertex]
        inwards, outwards = inwards / math.hypot(inwards[0], inwards[1]), outwards / math.hypot(outwards[0], outwards[1])
        for k in range(directions.shape[0]):
            dx, dy = directions[k]
            angle = math.atan2(cross(inwards[0], inwards[1], dx, dy), inwards[0] * dx + inwards[1] * dy)
            order[k] = angle + (100.0 if _kind(inwards, outwards, dx, dy) == LEAVING else 0.0)
        for k in _in_order(order):
            dx, dy = directions[k]
            kind = _kind(inwards, outwards, dx, dy)
            if kind < 0:
                continue
            ahead = 0.0 if kind == ARRIVING else _reach(outline, vertex, dx, dy, 1.0)
            back = 0.0 if kind == LEAVING else _reach(outline, vertex, dx, dy, -1.0)
            line = lines[size]
            line[0], line[1], line[2], line[3], line[4], line[5] = outline[vertex, 0], outline[vertex, 1], dx, dy, ahead, back
            places[size, 0], places[size, 1] = place, kind
            size += 1
    return lines[:size].copy(), places[:size].copy()


@njit(cache=True)
def _in_order(values: np.ndarray) -> np.ndarray:
    """Return the places of few values in rising order, by insertion: `np.argsort` takes longer to compile than all this file's loops."""
    order = np.empty(values.size, np.int64)
    for new in range(values.size):
        place = new
        while place > 0 and values[order[place - 1]] > values[new]:
            order[place] = order[place - 1]
            place -= 1
        order[place] = new
    return order


@njit(cache=True)
def _chain(swept: np.ndarray, start: int, stop: int) -> float:
    """Return twice the signed area swept from the origin along the outline from place `start` to `stop` (places count on past a turn)."""
    count = swept.shape[0] - 1
    turns = stop // count - start // count
    return swept[stop % count] - swept[start % count] + turns * swept[count]


@njit(cache=True, error_model="numpy")
def _ahead(x: float, y: float, adx: float, ady: float, reach: float, bdx: float, bdy: float, reach_back: float) -> float:
    """Return how far a line of direction a runs to where it crosses one of direction b through the point (x, y) from its own; -1 if it does
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
    """Return the area between the outline and two lines that meet in (x, y); inf where they go around the outline the wrong way."""
    swept_by_lines = cross(a[0], a[1], x, y) + cross(x, y, b[0], b[1])
    area = 0.5 * (swept_by_lines - _chain(swept, place_a, place_b))
    return max(area, 0.0) if area > -SLACK else np.inf


@njit(cache=True)
def _pocket(a: np.ndarray, place_a: np.ndarray, b: np.ndarray, place_b: np.ndarray, swept: np.ndarray) -> float:
    """Return the area between the outline and the corner where line a is left for line b; inf if they make no corner outside."""
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
    """Return (starts, targets, areas): for each of the first `sources` lines, all later lines within `span` places that it makes a
    corner with.
    """
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
    """Return (lines, 2): half the pocket of each line of a with the same line of b, its mirror image beyond the axis: where
    both make a corner (column 0), or are one line across the axis (column 1); inf where they do not.
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
    for i in range(values.size):
        grown[i] = values[i]
    return grown
