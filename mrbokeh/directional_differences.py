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

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from math import ceil, floor, gcd

import numpy as np
from jaxtyping import Float64

from mrbokeh.aperture import Aperture
from mrbokeh.errors import InputError

Direction = tuple[int, int]
Taps = dict[tuple[int, int], float]

_PARALLEL = 1e-6


def downwards(direction: Direction) -> Direction:
    """The sense of a direction that the running sums follow: down, or to the right if level; without common factors."""
    dx, dy = direction
    divisor = gcd(dx, dy)
    if divisor == 0:
        raise InputError("a direction needs a step, but (0, 0) came")
    sense = 1 if dy > 0 or (dy == 0 and dx > 0) else -1
    return sense * dx // divisor, sense * dy // divisor


def edge_profile(direction: Direction, binary: bool = False) -> Taps:
    """{(x, y): weight}: the downward difference of the area below one step of an edge from the lattice point (0, 0).

    binary: a pixel belongs to the area if its centre does, as in the paper; otherwise by the share of its area. An upright
    edge has none. Weights of a column sum to 1; the number of columns is the run of the direction.
    """
    dx, dy = downwards(direction)
    taps: Taps = {}
    for column in range(abs(dx)):
        high, low = column * dy / abs(dx), (column + 1) * dy / abs(dx)
        x = column if dx > 0 else -column - 1
        if binary:
            taps[x, ceil(0.5 * (high + low) - 0.5)] = 1.0
            continue
        for y in range(floor(high), ceil(low) + 1):
            weight = _mean_ramp(y + 1, high, low) - 2.0 * _mean_ramp(y, high, low) + _mean_ramp(y - 1, high, low)
            if weight > 1e-12:
                taps[x, y] = weight
    return taps


def _mean_ramp(y: float, high: float, low: float) -> float:
    """Mean of max(0, y - t) for t spread evenly over [high, low]."""
    if y <= high:
        return 0.0
    return y - 0.5 * (high + low) if y >= low else (y - high) ** 2 / (2.0 * (low - high))


def differenced_kernel(corners: Sequence[tuple[int, int]], binary: bool = True) -> Mapping[Direction, Taps]:
    """K'' of the paper's Eq. 4 for a polygon with its corners on the lattice: the non-zero elements, by direction.

    corners in the order in which x turns towards y (clockwise on screen). binary as in `edge_profile`.
    """
    grouped: dict[Direction, Taps] = {}
    for here, there in zip(corners, (*corners[1:], corners[0]), strict=True):
        direction = downwards((there[0] - here[0], there[1] - here[1]))
        if direction[0] == 0:
            continue
        taps = grouped.setdefault(direction, {})
        for (x, y), weight in edge_profile(direction, binary).items():
            for end, sign in ((here, 1.0), (there, -1.0)):
                place = (end[0] + x, end[1] + y)
                taps[place] = taps.get(place, 0.0) + sign * weight * (1 if direction[0] > 0 else -1)
    return {direction: {place: weight for place, weight in taps.items() if weight} for direction, taps in grouped.items()}


@dataclass(frozen=True)
class PolygonCorners:
    """Weighted polygons as edges and corners, per unit of radius. Corner i lies between edges before[i] and after[i].

    direction: of each edge, downwards. slope: det(direction, point of the edge) at radius 1. curvature: half the second
    derivative of the weighted area by the edge's offset. sign: of a corner's impulse, weight included; its direct effect is
    -run(d) on the direction of the edge before and +run(d) on the one after, where run is the sign of the x of d.
    area: of all polygons, weighted, at radius 1.
    """

    direction: tuple[Direction, ...]
    slope: Float64[np.ndarray, " edges"]
    curvature: Float64[np.ndarray, " edges"]
    before: tuple[int, ...]
    after: tuple[int, ...]
    sign: Float64[np.ndarray, " corners"]
    area: float

    @property
    def origin(self) -> Float64[np.ndarray, " edges"]:
        """What det(direction, .) adds for the centre of a pixel over its top left corner."""
        return np.array([0.5 * (dx - dy) for dx, dy in self.direction])


def polygon_corners(aperture: Aperture, directions: Sequence[Direction]) -> PolygonCorners:
    """Edges and corners of an aperture whose edges all run along `directions` (see mrbokeh.polygon_rectification)."""
    known = sorted({downwards(direction) for direction in directions})
    edges: list[Direction] = []
    slopes, curvatures, befores, afters, signs = [], [], [], [], []
    area = 0.0
    for outline, weight in zip(aperture.outlines, aperture.weights, strict=True):
        first = len(edges)
        signed_area = _area(outline)
        walk = list(_with_turns(_walk(outline, known)))
        oriented = weight * np.sign(signed_area)
        for i, (step, point) in enumerate(walk):
            edges.append(downwards(step))
            slopes.append(_det(edges[-1], point))
            befores.append(first + (i - 1) % len(walk))
            afters.append(first + i)
            signs.append(oriented)
        curvatures += [oriented * each for each in _curvatures(edges[first:])]
        area += weight * abs(signed_area)
    return PolygonCorners(tuple(edges), np.array(slopes), np.array(curvatures), tuple(befores), tuple(afters), np.array(signs), area)


def _walk(outline: Float64[np.ndarray, "_ 2"], known: Sequence[Direction]) -> list[tuple[Direction, tuple[float, float]]]:
    """(step, where it starts) of every edge; edges that go straight on are one."""
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


def _with_turns(walk: Sequence[tuple[Direction, tuple[float, float]]]) -> Iterator[tuple[Direction, tuple[float, float]]]:
    """Edges of length zero where two neighbours do not span the lattice, so that afterwards all do."""
    for (previous, _), (step, point) in zip((walk[-1], *walk[:-1]), walk, strict=True):
        while abs(_det(previous, step)) != 1:
            previous = _next_turn(previous, step)
            yield previous, point
        yield step, point


def _next_turn(previous: Direction, step: Direction) -> Direction:
    """The step between both that spans the lattice with `previous` and is nearest to `step`."""
    turn = 1 if _det(previous, step) >= 0 else -1
    reach = max(map(abs, (*previous, *step)))
    between = [
        (x, y)
        for x in range(-reach, reach + 1)
        for y in range(-reach, reach + 1)
        if _det(previous, (x, y)) == turn and turn * _det((x, y), step) >= 0
    ]
    return min(between, key=lambda each: (abs(_det(each, step)), each[0] ** 2 + each[1] ** 2))


def _curvatures(edges: Sequence[Direction]) -> list[float]:
    """Half the second derivative of a polygon's area by the offset of each edge, neighbours held: it grows shorter or longer."""
    curvatures = []
    for i, (dx, dy) in enumerate(edges):
        before, after = edges[i - 1], edges[(i + 1) % len(edges)]
        into, out = _det(before, (dx, dy)), _det((dx, dy), after)
        along = (after[0] / out + before[0] / into) * dx + (after[1] / out + before[1] / into) * dy
        curvatures.append(-0.5 * along / (dx * dx + dy * dy))
    return curvatures


def _det(a: Sequence[float], b: Sequence[float]) -> float:
    return a[0] * b[1] - a[1] * b[0]


def _area(outline: Float64[np.ndarray, "_ 2"]) -> float:
    x, y = outline.T
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y))
