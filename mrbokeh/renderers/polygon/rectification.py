"""Kernel rectification: the smallest polygon around an outline whose edges all run along a few given directions.

Moroto, Hachisuka, Umetani, "Fast Polygonal Splatting using Directional Kernel Difference", 2021, Section 4. Their graph:
a node is a line of an admitted direction that touches the outline at a vertex from outside; an arc is a corner of two such
lines, its weight the area between the corner and the outline; the cheapest walk once around with at most N nodes is the
polygon. A line touches a vertex that points outwards where it leaves the outline on one side; an edge may also end at a
vertex that points inwards (the bottom of a notch). The result is the smallest polygon all of whose edges touch so.
Edges that end on the middle of a slanted edge are left out, as in the paper: they would cut teeth into straight sides.

Beyond the paper: the symmetry that the outline shares with the directions is kept (Section 6.1 leaves this open). The walk
then covers one sector, from mirror axis to mirror axis or from a line to its turned image, and is unfolded: the smallest
polygon among those with the same symmetry, not a symmetrised one. For the walks outlines are centred, turn with positive area and
reach 1 from their middle (`shape`).
"""

from collections.abc import Sequence
from dataclasses import replace
from math import gcd
from typing import Literal

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.polygon.outlines import (
    EXACT,
    NO_SYMMETRY,
    Outline,
    Sector,
    area,
    centroid,
    corner_points,
    sectors,
    swept_areas,
    without_flat_vertices,
)
from mrbokeh.system.errors import InputError

PAPER_DIRECTIONS = ((1, 0), (0, 1), (1, 1), (1, -1), (1, 2), (1, -2), (2, 1), (2, -1))
"""The set D of Fig. 6: the slopes whose differenced edges have few non-zero elements."""


def rectify(
    outline: Outline,
    directions: Sequence[tuple[int, int]] = PAPER_DIRECTIONS,
    max_edges: int = 16,
    fit: Literal["enclosing", "area"] = "enclosing",
    symmetry_cost: float = 0.05,
) -> Outline:
    """Return the smallest polygon (W, 2) around an outline (V, 2), with at most `max_edges` edges along `directions`.

    The outline may be concave and wind either way (the result winds alike), but must not cross itself. One whose edges run
    along the directions already comes back as it is. Where a notch narrows, the result may touch itself in a point. Time
    grows with V squared: milliseconds for 64 vertices, up to some seconds for 1000 of a ragged outline.
    directions: small integer steps (x, y), as the renderer sums along them.
    fit: "enclosing" contains the outline; "area" has its area and centroid (see same_area_and_centroid).
    symmetry_cost: the result has the largest symmetry (mirrors, half and quarter turns) shared by outline and directions
    for which it is larger than the smallest polygon of all by at most this share of the outline's area. 0 keeps only symmetry
    that is free, inf all there is, a negative cost none on purpose. A symmetric polygon may use fewer than `max_edges`:
    all four mirrors and quarter turns leave multiples of four. For a given symmetry more edges never mean more area; where
    they bring a larger one within reach, the area may rise by up to the cost.
    """
    steps = _unit_steps(directions, max_edges)
    _check(outline)
    if (ready := _already_rectified(outline, steps, max_edges)) is not None:
        return ready
    clockwise = area(outline) < 0.0
    middle = centroid(outline)
    extent = float(np.abs(outline - middle).max())
    shape = without_flat_vertices((outline[::-1] if clockwise else outline) - middle) / extent
    tangent = len(steps) <= max_edges and _is_convex(shape)
    polygon = _tangent_polygon(shape, steps) if tangent else smallest_polygon(shape, steps, max_edges, symmetry_cost)
    if polygon is None:
        raise InputError(f"no polygon of at most {max_edges} edges along {tuple(directions)} encloses the outline: allow more of either")
    polygon = middle + extent * (polygon[::-1] if clockwise else polygon)
    return same_area_and_centroid(polygon, outline) if fit == "area" else polygon


def same_area_and_centroid(rectified: Outline, outline: Outline) -> Outline:
    """Return the rectified polygon scaled and shifted to the outline's area and centroid.

    The enclosing polygon is too large on all sides, so a blur with it is too wide and, for lopsided shapes, off centre. Scaled
    about its centroid it keeps the directions of its edges; it then crosses the outline, as much inside as outside.
    """
    scale = np.sqrt(abs(area(outline)) / abs(area(rectified)))
    return centroid(outline) + scale * (rectified - centroid(rectified))


def rectify_aperture(aperture: Aperture, directions: Sequence[tuple[int, int]] = PAPER_DIRECTIONS, max_edges: int = 16) -> Aperture:
    """Return the aperture with every outline rectified on its own, at most `max_edges` edges each.

    Each outline keeps its area and centroid, so that every weight still means the same light in the same place. A hole
    (negative weight) is treated like any other outline: once fitted by area, enclosing it or being enclosed is all one.
    """
    return replace(aperture, outlines=tuple(rectify(outline, directions, max_edges, fit="area") for outline in aperture.outlines))


def _unit_steps(directions: Sequence[tuple[int, int]], max_edges: int) -> Float64[np.ndarray, "_ 2"]:
    """Return both senses of every direction once, as unit vectors."""
    if max_edges < 3:
        raise InputError(f"a polygon has at least 3 edges, but at most {max_edges} were asked for")
    reduced = set()
    for x, y in directions:
        if int(x) != x or int(y) != y or (x, y) == (0, 0):
            raise InputError(f"a direction is a step of two whole numbers, not both 0, but ({x}, {y}) came")
        divisor = gcd(int(x), int(y))
        reduced |= {(int(x) // divisor, int(y) // divisor), (-int(x) // divisor, -int(y) // divisor)}
    if len(reduced) < 4:
        raise InputError(f"edges along {tuple(directions)} cannot close: give at least two directions that are not parallel")
    steps = np.array(sorted(reduced), np.float64)
    return steps / np.hypot(*steps.T)[:, None]


def _check(outline: Outline) -> None:
    from mrbokeh.renderers.polygon._rectification_numba import crosses_itself

    if outline.ndim != 2 or outline.shape[0] < 3 or outline.shape[1] != 2 or not np.isfinite(outline).all():
        raise InputError("an outline must be (V, 2) with at least 3 vertices and finite numbers")
    extent = np.ptp(outline, axis=0).max()
    if abs(area(outline)) <= EXACT * extent**2:
        raise InputError("an outline must enclose an area, but its vertices lie on a line")
    shape = without_flat_vertices(outline - outline[0]) / extent
    if not (_is_convex(shape) or _is_convex(shape[::-1])) and crosses_itself(shape):
        raise InputError("an outline must not cross itself; split it into simple outlines first")


def _already_rectified(outline: Outline, steps: Outline, max_edges: int) -> Outline | None:
    """Return a copy of the outline if its edges run along the steps and are few enough, with no more than its flat vertices left out."""
    for candidate in (outline, without_flat_vertices(outline)):
        edges = np.roll(candidate, -1, axis=0) - candidate
        lengths = np.hypot(*edges.T)
        if len(candidate) > max_edges or (lengths == 0.0).any():
            continue
        sines = np.abs(edges[:, :1] * steps[:, 1] - edges[:, 1:] * steps[:, 0]) / lengths[:, None]
        if (sines.min(axis=1) <= EXACT).all():
            return candidate.copy()
    return None


def _is_convex(shape: Outline) -> bool:
    """Return whether an outline of positive area turns one way at all vertices, and once around."""
    edges = np.roll(shape, -1, axis=0) - shape
    following = np.roll(edges, -1, axis=0)
    turns = np.arctan2(edges[:, 0] * following[:, 1] - edges[:, 1] * following[:, 0], (edges * following).sum(axis=1))
    return bool((turns > 0.0).all() and turns.sum() < 3.0 * np.pi)


def _tangent_polygon(shape: Outline, steps: Outline) -> Outline:
    """Return the smallest polygon around a convex outline: what the lines along all the steps that touch it enclose.

    It is as symmetric as the outline, not more. Nothing here is compiled: most openings are convex, and the walks take 3 s to compile.
    """
    in_turn = steps[np.argsort(np.arctan2(steps[:, 1], steps[:, 0]))]
    touched = shape[(shape @ (in_turn[:, ::-1] * [1.0, -1.0]).T).argmax(axis=0)]
    return without_flat_vertices(corner_points(np.column_stack([touched, in_turn]), 0.0))


def smallest_polygon(shape: Outline, steps: Outline, max_edges: int, symmetry_cost: float) -> Outline | None:
    """Return the smallest polygon of the largest symmetry that is not too dear; None where nothing closes."""
    plain = _simple_walk(Sector(shape, len(shape), NO_SYMMETRY, (np.eye(2),)), shape, steps, max_edges)
    if plain is None or symmetry_cost < 0.0:
        return plain
    for sector in sectors(shape, steps):
        polygon = _simple_walk(sector, shape, steps, max_edges)
        if polygon is not None and area(polygon) <= area(plain) + symmetry_cost * area(shape) + EXACT:
            return polygon
    return plain


def _simple_walk(sector: Sector, shape: Outline, steps: Outline, max_edges: int) -> Outline | None:
    """Return the smallest polygon around `shape` of the sector's symmetry that does not cross itself.

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
    """Return whether a polygon crosses itself. Made a little smaller first: then one that touches itself in a point does not."""
    from mrbokeh.renderers.polygon._rectification_numba import crosses_itself

    edges = np.roll(polygon, -1, axis=0) - polygon
    return bool(crosses_itself(corner_points(np.column_stack([polygon, edges / np.hypot(*edges.T)[:, None]]), -1e3 * EXACT)))


def _enclosing(lines: np.ndarray, shape: Outline) -> Outline:
    """Return the polygon of lines in their order, all moved outwards by as much as the shape differs from its symmetric twin."""
    from mrbokeh.renderers.polygon._rectification_numba import farthest_from_outline

    outwards, polygon = 0.0, without_flat_vertices(corner_points(lines, 0.0))
    for _ in range(8):
        missing = max(farthest_from_outline(shape, polygon, 1), farthest_from_outline(polygon, shape, -1))
        if missing <= EXACT:
            break
        outwards += missing
        polygon = without_flat_vertices(corner_points(lines, outwards))
    return polygon


def _turned_walk(sector: Sector, steps: Outline, most: int) -> np.ndarray:
    """Return lines (x, y, dx, dy) of the smallest polygon, with `most` of them in each of the turned parts."""
    from mrbokeh.renderers.polygon import _rectification_numba as pockets
    from mrbokeh.renderers.polygon import _rectification_numba as walks
    from mrbokeh.renderers.polygon._rectification_numba import touching_lines

    lines, places = touching_lines(sector.outline, 0, sector.size - 1, steps)
    turn, count = sector.to_image[0], len(lines)
    next_period = places + np.array([sector.size, 0])
    lines, places = np.concatenate([lines, _turned(lines, turn)]), np.concatenate([places, next_period])
    starts, targets, areas = pockets.corners(lines, places, count, sector.size, swept_areas(sector.outline))
    walk = walks.cheapest_turn(count, _fewest_origins(starts, targets), starts, targets, areas, most)
    return np.concatenate([_turned(lines[walk, :4], np.linalg.matrix_power(turn, i)) for i in range(sector.symmetry.turns)])


def _fewest_origins(starts: np.ndarray, targets: np.ndarray) -> np.ndarray:
    """Return the lines of which every closed walk contains one: those with a corner across one cut of the outline, for the best cut."""
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
    """Return lines (x, y, dx, dy) of the smallest polygon, with `most` of them in each pair of mirrored sectors."""
    from mrbokeh.renderers.polygon import _rectification_numba as pockets
    from mrbokeh.renderers.polygon import _rectification_numba as walks
    from mrbokeh.renderers.polygon._rectification_numba import touching_lines

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
    """Return the mirror images of lines (x, y, dx, dy, forward, backward), with the outline to their left as before."""
    return np.column_stack([lines[:, :2] @ mirror.T, -lines[:, 2:4] @ mirror.T, lines[:, [5, 4]]])


def _mirrored_places(places: np.ndarray, axis: int) -> np.ndarray:
    """Return places (place, kind) of the mirror images, where the axis lies at place `axis`: arriving lines leave, and the other way
    round.
    """
    from mrbokeh.renderers.polygon._rectification_numba import ARRIVING, LEAVING, THROUGH

    kinds = places[:, 1]
    return np.column_stack([2 * axis - places[:, 0], np.where(kinds == THROUGH, THROUGH, ARRIVING + LEAVING - kinds)])


def _turned(lines: np.ndarray, turn: np.ndarray) -> np.ndarray:
    return np.column_stack([lines[:, :2] @ turn.T, lines[:, 2:4] @ turn.T, lines[:, 4:]])
