"""Kernel rectification: the smallest polygon around an outline whose edges all run along a few given directions.

Moroto, Hachisuka, Umetani, "Fast Polygonal Splatting using Directional Kernel Difference", 2021, Section 4. Their graph:
a node is a line of an admitted direction that touches the outline at a vertex from outside; an arc is a corner of two such
lines, its weight the area between the corner and the outline; the cheapest walk once around with at most N nodes is the
polygon. A line touches a vertex that points outwards where it leaves the outline on one side; an edge may also end at a
vertex that points inwards (the bottom of a notch). The result is the smallest polygon all of whose edges touch so.
Edges that end on the middle of a slanted edge are left out, as in the paper: they would cut teeth into straight sides.

Beyond the paper: the symmetry that the outline shares with the directions is kept (Section 6.1 leaves this open). The walk
then covers one sector, from mirror axis to mirror axis or from a line to its turned image, and is unfolded: the smallest
polygon among those with the same symmetry, not a symmetrised one.
"""

from collections.abc import Sequence
from dataclasses import replace
from math import gcd
from typing import Literal

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.polygon.outline_geometry import EXACT, Outline, area, centroid, without_flat_vertices
from mrbokeh.renderers.polygon.rectification_walks import smallest_polygon
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
    """The smallest polygon (W, 2) around an outline (V, 2), with at most `max_edges` edges along `directions`.

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
    polygon = smallest_polygon(shape, steps, max_edges, symmetry_cost)
    if polygon is None:
        raise InputError(f"no polygon of at most {max_edges} edges along {tuple(directions)} encloses the outline: allow more of either")
    polygon = middle + extent * (polygon[::-1] if clockwise else polygon)
    return same_area_and_centroid(polygon, outline) if fit == "area" else polygon


def area_excess(rectified: Outline, outline: Outline) -> float:
    """How much larger the rectified polygon is than its outline, as a share of the outline's area (0 = equal)."""
    return abs(area(rectified)) / abs(area(outline)) - 1.0


def same_area_and_centroid(rectified: Outline, outline: Outline) -> Outline:
    """The rectified polygon scaled and shifted to the outline's area and centroid.

    The enclosing polygon is too large on all sides, so a blur with it is too wide and, for lopsided shapes, off centre. Scaled
    about its centroid it keeps the directions of its edges; it then crosses the outline, as much inside as outside.
    """
    scale = np.sqrt(abs(area(outline)) / abs(area(rectified)))
    return centroid(outline) + scale * (rectified - centroid(rectified))


def rectify_aperture(aperture: Aperture, directions: Sequence[tuple[int, int]] = PAPER_DIRECTIONS, max_edges: int = 16) -> Aperture:
    """The aperture with every outline rectified on its own, at most `max_edges` edges each.

    Each outline keeps its area and centroid, so that every weight still means the same light in the same place. A hole
    (negative weight) is treated like any other outline: once fitted by area, enclosing it or being enclosed is all one.
    """
    return replace(aperture, outlines=tuple(rectify(outline, directions, max_edges, fit="area") for outline in aperture.outlines))


def _unit_steps(directions: Sequence[tuple[int, int]], max_edges: int) -> Float64[np.ndarray, "_ 2"]:
    """Both senses of every direction once, as unit vectors."""
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
    from mrbokeh.renderers.polygon._outline_geometry_numba import crosses_itself

    if outline.ndim != 2 or outline.shape[0] < 3 or outline.shape[1] != 2 or not np.isfinite(outline).all():
        raise InputError("an outline must be (V, 2) with at least 3 vertices and finite numbers")
    extent = np.ptp(outline, axis=0).max()
    if abs(area(outline)) <= EXACT * extent**2:
        raise InputError("an outline must enclose an area, but its vertices lie on a line")
    if crosses_itself(without_flat_vertices(outline - outline[0]) / extent):
        raise InputError("an outline must not cross itself; split it into simple outlines first")


def _already_rectified(outline: Outline, steps: Outline, max_edges: int) -> Outline | None:
    """A copy of the outline if its edges run along the steps and are few enough, with no more than its flat vertices left out."""
    for candidate in (outline, without_flat_vertices(outline)):
        edges = np.roll(candidate, -1, axis=0) - candidate
        lengths = np.hypot(*edges.T)
        if len(candidate) > max_edges or (lengths == 0.0).any():
            continue
        sines = np.abs(edges[:, :1] * steps[:, 1] - edges[:, 1:] * steps[:, 0]) / lengths[:, None]
        if (sines.min(axis=1) <= EXACT).all():
            return candidate.copy()
    return None
