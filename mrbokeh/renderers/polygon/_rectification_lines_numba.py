"""Compiled parts of kernel rectification: lines of given directions that touch an outline from outside.

Outlines here are closed, (V, 2), of unit size, do not cross themselves and turn with positive area, so that the inside
lies to the left of every edge. A line is a row (x, y, dx, dy, forward, backward) of `lines`: a vertex that it touches,
its unit direction with the outline to the left, and how far it runs from the vertex, either way, before it enters the
outline. The matching row of `places` is (index of the vertex, kind).
"""

import math

import numpy as np

from mrbokeh.renderers.polygon._outline_geometry_numba import cross
from mrbokeh.system.kernels import njit

THROUGH, ARRIVING, LEAVING = 0, 1, 2
"""Kinds of line: touching on both sides of the vertex; ending or starting at a vertex that points inwards."""

ASIDE = 1e-10
"""Rays run this far to the right of their line: what touches the line from the left does not stop them."""

FLAT = 1e-11
"""Sines below this are a straight angle."""


@njit(cache=True)
def _kind(inwards: np.ndarray, outwards: np.ndarray, dx: float, dy: float) -> int:
    """How a line of direction (dx, dy) touches the vertex between two unit edges, or -1 if it enters the outline."""
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
    """How far the line through a vertex runs, ahead (sense 1) or back (-1), until it meets an edge that is not the vertex's own."""
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
    """(lines, places) of all lines along `directions` (unit, both senses) that touch the vertices first..last from outside.

    Ordered along the outline; at a vertex that points outwards by direction, at one that points inwards arriving lines first."""
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
        for k in np.argsort(order):
            dx, dy = directions[k]
            kind = _kind(inwards, outwards, dx, dy)
            if kind < 0:
                continue
            ahead = 0.0 if kind == ARRIVING else _reach(outline, vertex, dx, dy, 1.0)
            back = 0.0 if kind == LEAVING else _reach(outline, vertex, dx, dy, -1.0)
            lines[size] = np.array([outline[vertex, 0], outline[vertex, 1], dx, dy, ahead, back])
            places[size, 0], places[size, 1] = place, kind
            size += 1
    return lines[:size].copy(), places[:size].copy()
