"""Directional differences: a polygon's kernel as a few impulses at its corners (Moroto, Hachisuka, Umetani, 2021, Section 5).

A kernel is differenced downwards; what is left lies along its edges. Each edge of direction d is differenced along d; what is
left lies at its two ends. Going back, impulses are summed along their direction (Sum_d), the profile of one step of the
edge is laid over every point (`edge_profile`), and the sum downwards gives the kernel.

Here the profile is a table of its own, so that a corner on the pixel lattice is a single impulse, which both of its edges
share; the paper splats the product of both. With the profile of exact area coverage the kernel is anti-aliased.

Corners between lattice points: an edge is a line det(d, x) = c. It is split between the two lattice lines around it, floor(c)
and floor(c) + 1, by the fraction of c, and a corner between the four crossings of both edges' lines. Every such crossing is
a lattice point if the two directions span the lattice (det = +-1); a corner that turns farther is walked in several such turns
with edges of length zero between them. The kernel is then the mean over polygons whose edges move by less than one lattice
line (0.45 to 1 px): continuous in the diameter and in place. Its light is exact after `PolygonCorners.area` is corrected by
the curvature of the area, sum of curvature f (1 - f).

The lattice holds the corners of pixels: lattice point (0, 0) is the top left corner of pixel (0, 0).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from math import ceil, floor, gcd

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.system.errors import InputError

Direction = tuple[int, int]
Taps = dict[tuple[int, int], float]

BLUNTED = 1.0
"""Steps that an edge inserted to walk a sharp corner in several turns cuts off its tip."""

_PARALLEL = 1e-6


def downwards(direction: Direction) -> Direction:
    """Return the sense of a direction that the running sums follow: down, or to the right if level; without common factors."""
    dx, dy = direction
    divisor = gcd(dx, dy)
    if divisor == 0:
        raise InputError("a direction needs a step, but (0, 0) came")
    sense = 1 if dy > 0 or (dy == 0 and dx > 0) else -1
    return sense * dx // divisor, sense * dy // divisor


def edge_profile(direction: Direction) -> Taps:
    """Return {(x, y): weight}: the downward difference of the area below one step of an edge from the lattice point (0, 0).

    Pixels count by the share of their area that belongs to it. An upright edge has no profile. Weights of a column sum to 1; the
    number of columns is the run of the direction.
    """
    dx, dy = downwards(direction)
    taps: Taps = {}
    for column in range(abs(dx)):
        high, low = column * dy / abs(dx), (column + 1) * dy / abs(dx)
        x = column if dx > 0 else -column - 1
        for y in range(floor(high), ceil(low) + 1):
            weight = _mean_ramp(y + 1, high, low) - 2.0 * _mean_ramp(y, high, low) + _mean_ramp(y - 1, high, low)
            if weight > 1e-12:
                taps[x, y] = weight
    return taps


def _mean_ramp(y: float | int, high: float, low: float) -> float:
    """Return the mean of max(0, y - t) for t spread evenly over [high, low]."""
    if y <= high:
        return 0.0
    return y - 0.5 * (high + low) if y >= low else (y - high) ** 2 / (2.0 * (low - high))


@dataclass(frozen=True)
class PolygonCorners:
    """Weighted polygons as edges and corners. Corner i lies between the edges before[i] and after[i].

    At a signed radius r, in pixels, an edge is the line det(direction, x) = slope r + sign(r) shift. direction: downwards.
    curvature: half the second derivative of the weighted area by that offset. weight: of a corner's impulse, by the sense in
    which the outline winds; its effect is -run on the direction of the edge before and +run on the one after, run being the
    sign of the direction's x. area: coefficients of r^2 and of 1 in the weighted area of all polygons. shortest: in steps, the
    shortest edge of the outlines at radius 1.
    """

    direction: tuple[Direction, ...]
    slope: Float64[np.ndarray, " edges"]
    shift: Float64[np.ndarray, " edges"]
    curvature: Float64[np.ndarray, " edges"]
    before: tuple[int, ...]
    after: tuple[int, ...]
    weight: Float64[np.ndarray, " corners"]
    area: tuple[float, float]
    shortest: float

    @property
    def origin(self) -> Float64[np.ndarray, " edges"]:
        """Increment of det(direction, .) from a pixel's top left corner to its centre."""
        return np.array([0.5 * (dx - dy) for dx, dy in self.direction])

    @property
    def growth(self) -> float:
        """Amount to add to r^2 so that the area is right on average over the places of edges between lattice lines."""
        return -(self.area[1] + self.curvature.sum() / 6.0) / self.area[0]


@dataclass(frozen=True)
class _Outline:
    """Polygon as a walk: the step of every edge in order, the offset of its line at radius 1, and whether the edge was inserted."""

    steps: tuple[Direction, ...]
    slope: Float64[np.ndarray, " edges"]
    inserted: tuple[bool, ...]

    @property
    def lengths(self) -> Float64[np.ndarray, "edges edges"]:
        """Lengths of the edges, in steps, as a matrix times the offsets of all edges' lines."""
        count = len(self.steps)
        matrix = np.zeros((count, count))
        for i, step in enumerate(self.steps):
            before, here, after = (downwards(self.steps[j % count]) for j in (i - 1, i, i + 1))
            sense = 1 if here == step else -1
            into, out = _det(before, here), _det(here, after)
            along = (after[0] / out + before[0] / into) * here[0] + (after[1] / out + before[1] / into) * here[1]
            matrix[i, i] += sense * along / (here[0] ** 2 + here[1] ** 2)
            matrix[i, i - 1] -= sense / into
            matrix[i, (i + 1) % count] -= sense / out
        return matrix

    @property
    def quadratic(self) -> Float64[np.ndarray, "edges edges"]:
        """The area as a quadratic form of the offsets."""
        senses = np.array([1.0 if downwards(step) == step else -1.0 for step in self.steps])
        return -0.5 * senses[:, None] * self.lengths

    @property
    def shift(self) -> Float64[np.ndarray, " edges"]:
        """Distances to move inserted edges in so that each gets BLUNTED steps long."""
        shift = np.zeros(len(self.steps))
        inserted = np.array(self.inserted)
        if inserted.any():
            shift[inserted] = np.linalg.solve(self.lengths[np.ix_(inserted, inserted)], np.full(int(inserted.sum()), BLUNTED))
        return shift


def polygon_corners(aperture: Aperture, directions: Sequence[Direction]) -> PolygonCorners:
    """Return edges and corners of an aperture whose edges all run along `directions` (see mrbokeh.renderers.polygon.rectification)."""
    known = sorted({downwards(direction) for direction in directions})
    edges: list[Direction] = []
    slopes, shifts, curvatures, weights = [], [], [], []
    befores: list[int] = []
    afters: list[int] = []
    area, shortest = np.zeros(2), np.inf
    for points, weight in zip(aperture.outlines, aperture.weights, strict=True):
        outline = _with_turns(_walk(points, known))
        first, count = len(edges), len(outline.steps)
        edges += [downwards(step) for step in outline.steps]
        form, shift = outline.quadratic, outline.shift
        shortest = min(shortest, float(np.abs(outline.lengths @ outline.slope)[~np.array(outline.inserted)].min()))
        signed_area = float(outline.slope @ form @ outline.slope)
        oriented = weight * np.sign(signed_area)
        slopes.append(outline.slope)
        shifts.append(shift)
        curvatures.append(oriented * np.diag(form))
        befores += [first + (i - 1) % count for i in range(count)]
        afters += range(first, first + count)
        weights += [oriented] * count
        area += oriented * np.array([signed_area, shift @ form @ shift])
    slope, shift, curvature = (np.concatenate(each) for each in (slopes, shifts, curvatures))
    parts = (float(area[0]), float(area[1]))
    return PolygonCorners(
        direction=tuple(edges),
        slope=slope,
        shift=shift,
        curvature=curvature,
        before=tuple(befores),
        after=tuple(afters),
        weight=np.array(weights),
        area=parts,
        shortest=shortest,
    )


def _walk(outline: Float64[np.ndarray, "_ 2"], known: Sequence[Direction]) -> list[tuple[Direction, tuple[float, float]]]:
    """Return (step, start) of every edge; edges that go straight on are one."""
    walk: list[tuple[Direction, tuple[float, float]]] = []
    extent = float(np.ptp(outline, axis=0).max())
    for here, there in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if np.abs(there - here).max() > _PARALLEL * extent:
            step = _step_along(there - here, known)
            if not walk or walk[-1][0] != step:
                walk.append((step, (float(here[0]), float(here[1]))))
    if len(walk) > 1 and walk[0][0] == walk[-1][0]:
        walk = walk[1:]
    return walk


def _step_along(edge: Float64[np.ndarray, "2"], known: Sequence[Direction]) -> Direction:
    for dx, dy in known:
        if abs(dx * edge[1] - dy * edge[0]) <= _PARALLEL * np.hypot(dx, dy) * np.hypot(*edge):
            sense = 1 if dx * edge[0] + dy * edge[1] > 0 else -1
            return sense * dx, sense * dy
    raise InputError(f"an edge of the outline runs along ({edge[0]:.4g}, {edge[1]:.4g}), which is none of {tuple(known)}: rectify it first")


def _with_turns(walk: Sequence[tuple[Direction, tuple[float, float]]]) -> _Outline:
    """Insert edges of length zero where two neighbours do not span the lattice, so that afterwards all do."""
    steps, slopes, inserted = [], [], []
    for (previous, _), (step, point) in zip((walk[-1], *walk[:-1]), walk, strict=True):
        while abs(_det(previous, step)) != 1:
            previous = _next_turn(previous, step)
            steps.append(previous)
            slopes.append(_det(downwards(previous), point))
            inserted.append(True)
        steps.append(step)
        slopes.append(_det(downwards(step), point))
        inserted.append(False)
    return _Outline(tuple(steps), np.array(slopes), tuple(inserted))


def _next_turn(previous: Direction, step: Direction) -> Direction:
    """Return the step between both that spans the lattice with `previous` and is nearest to `step`."""
    turn = 1 if _det(previous, step) >= 0 else -1
    reach = max(map(abs, (*previous, *step)))
    between = [
        (x, y)
        for x in range(-reach, reach + 1)
        for y in range(-reach, reach + 1)
        if _det(previous, (x, y)) == turn and turn * _det((x, y), step) >= 0
    ]
    return min(between, key=lambda each: (abs(_det(each, step)), each[0] ** 2 + each[1] ** 2))


def _det(a: Sequence[float | int], b: Sequence[float | int]) -> float | int:
    return a[0] * b[1] - a[1] * b[0]
