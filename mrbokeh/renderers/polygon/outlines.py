"""Closed outlines as points (V, 2) in float64: area, centre, corners of lines, and the symmetry that they share with a grid of pixels.

Areas are positive where x turns towards y. A symmetric outline is unfolded from one of its sectors.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

EXACT = 1e-9
"""Half extents below which two points are one, and sines below which an edge has a direction."""

Outline = Float64[np.ndarray, "_ 2"]


def area(outline: Outline) -> float:
    """Return the signed area: positive where x turns towards y."""
    x, y = (outline - outline[0]).T
    return 0.5 * float(np.dot(x, np.roll(y, -1)) - np.dot(np.roll(x, -1), y))


def centroid(outline: Outline) -> Float64[np.ndarray, "2"]:
    """Return the centre of the enclosed area."""
    points = outline - outline[0]
    following = np.roll(points, -1, axis=0)
    swept = points[:, 0] * following[:, 1] - following[:, 0] * points[:, 1]
    return outline[0] + (swept[:, None] * (points + following)).sum(axis=0) / (3.0 * swept.sum())


def without_flat_vertices(outline: Outline) -> Outline:
    """Return the outline without repeated vertices and those within rounding of the line between their neighbours."""
    extent = np.ptp(outline, axis=0).max()
    for _ in range(2):
        outline = outline[np.hypot(*(outline - np.roll(outline, 1, axis=0)).T) > EXACT * extent]
        step, onwards = outline - np.roll(outline, 1, axis=0), np.roll(outline, -1, axis=0) - outline
        aside = np.abs(step[:, 0] * onwards[:, 1] - step[:, 1] * onwards[:, 0])
        flat = (aside <= 1e-12 * extent * np.hypot(*(step + onwards).T)) & ((step * onwards).sum(axis=1) > 0.0)
        outline = outline[~flat]
    return outline


def corner_points(lines: np.ndarray, outwards: float) -> Outline:
    """Return the polygon of lines (x, y, dx, dy) in their order, all moved `outwards`, to the right of their directions."""
    points, along = lines[:, :2] + outwards * lines[:, 3:1:-1] * [1.0, -1.0], lines[:, 2:4]
    offset, following = np.roll(points, -1, axis=0) - points, np.roll(along, -1, axis=0)
    ahead = _cross(offset, following) / _cross(along, following)
    return points + ahead[:, None] * along


def _cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]


def swept_areas(outline: Outline) -> np.ndarray:
    """Return (V + 1,) twice the area swept from the origin along the outline up to each vertex, and once around."""
    return np.concatenate([[0.0], np.cumsum(_cross(outline, np.roll(outline, -1, axis=0)))])


ALIKE = 1e-3
"""An outline counts as symmetric if its mirror image stays this close to it, in its half extents."""


@dataclass(frozen=True)
class Symmetry:
    """Symmetry by turns of 1 / `turns` of a full one and, unless `axis` is None, mirrors: one axis at `axis` times 45 degrees."""

    turns: int
    axis: int | None

    @property
    def mirrors(self) -> list[np.ndarray]:
        """Mirror matrices, by angle of their axes."""
        return [] if self.axis is None else [mirror_matrix(self.axis + 4 * i // self.turns) for i in range(self.turns)]

    @property
    def elements(self) -> list[np.ndarray]:
        return self.mirrors + [rotation_matrix(4 * i // self.turns) for i in range(1, self.turns)]


def mirror_matrix(eighths: int) -> np.ndarray:
    """Return the matrix that mirrors at the axis through the origin at `eighths` times 45 degrees."""
    return rotation_matrix(eighths % 4) @ np.diag([1.0, -1.0])


def rotation_matrix(quarters: int) -> np.ndarray:
    """Return the matrix that turns by `quarters` times 90 degrees, x towards y."""
    return np.linalg.matrix_power(np.array([[0.0, -1.0], [1.0, 0.0]]), quarters)


NO_SYMMETRY = Symmetry(1, None)
SYMMETRIES = (
    *(Symmetry(4, 0), Symmetry(2, 0), Symmetry(2, 1), Symmetry(4, None)),
    *(Symmetry(1, axis) for axis in range(4)),
    Symmetry(2, None),
)
"""All that a grid of pixels has, the largest first."""


@dataclass(frozen=True)
class Sector:
    """Exactly symmetric outline whose vertices 0 to `size` lie in one sector, and the matrices that map that onto the next one or two."""

    outline: Outline
    size: int
    symmetry: Symmetry
    to_image: tuple[np.ndarray, ...]


def sectors(shape: Outline, steps: Outline) -> Iterator[Sector]:
    """Yield the outline unfolded from one sector of every symmetry that it shares with the directions, the largest first."""
    from mrbokeh.renderers.polygon._rectification_numba import farthest_from_outline

    def holds(element: np.ndarray) -> bool:
        if not all(np.abs(steps - step).max(axis=1).min() < EXACT for step in steps @ element.T):
            return False
        return farthest_from_outline(shape @ element.T, shape, 0) <= ALIKE

    held = {tuple(element.astype(int).flat) for element in SYMMETRIES[0].elements if holds(element)}
    for symmetry in SYMMETRIES:
        if not {tuple(element.astype(int).flat) for element in symmetry.elements} <= held:
            continue
        unfolded = _unfolded_by_turns(shape, symmetry) if symmetry.axis is None else _unfolded_by_mirrors(shape, symmetry)
        if unfolded is None:
            continue
        outline, size, to_image = unfolded
        if farthest_from_outline(shape, outline, 0) <= ALIKE and farthest_from_outline(outline, shape, 0) <= ALIKE:
            yield Sector(outline, size, symmetry, to_image)


Unfolded = tuple[Outline, int, tuple[np.ndarray, ...]]


def _unfolded_by_turns(shape: Outline, symmetry: Symmetry) -> Unfolded | None:
    """Return the outline from vertex 0 to its turned image, repeated."""
    turn = rotation_matrix(4 // symmetry.turns)
    image = turn @ shape[0]
    edges = np.roll(shape, -1, axis=0) - shape
    share = np.clip(((image - shape) * edges).sum(axis=1) / (edges**2).sum(axis=1), 0.0, 1.0)
    nearest = int(np.hypot(*(shape + share[:, None] * edges - image).T).argmin())
    chain = shape[: nearest + 1]
    if np.hypot(*(chain[-1] - image)) < EXACT:
        chain = chain[:-1]
    if len(chain) == 0:
        return None
    return _repeated(chain, turn, symmetry.turns), len(chain), (turn,)


def _unfolded_by_mirrors(shape: Outline, symmetry: Symmetry) -> Unfolded | None:
    """Return the outline from one mirror axis to the next, mirrored and repeated; None if it does not cross every axis twice."""
    crossings = [crossing for mirror in symmetry.mirrors for crossing in _crossings(shape, mirror)]
    if len(crossings) != 2 * symmetry.turns:
        return None
    (start, at_start, first), (stop, at_stop, second) = sorted(crossings, key=lambda crossing: crossing[0])[:2]
    inner = shape[int(np.floor(start)) + 1 : int(np.ceil(stop))]
    apart = np.minimum(np.hypot(*(inner - at_start).T), np.hypot(*(inner - at_stop).T)) > EXACT
    chain = np.concatenate([at_start[None], inner[apart], at_stop[None]])
    period = np.concatenate([chain, (chain[1:-1] @ second.T)[::-1]])
    return _repeated(period, second @ first, symmetry.turns), len(chain) - 1, (first, second)


def _crossings(shape: Outline, mirror: np.ndarray) -> list[tuple[float, np.ndarray, np.ndarray]]:
    """Return (place along the outline, point on the axis, mirror) of every vertex on a mirror axis and every edge across it."""
    onto_axis = 0.5 * (np.eye(2) + mirror)
    normal = np.eye(2) - onto_axis
    normal = normal[np.abs(normal).sum(axis=1).argmax()]
    side = shape @ normal / np.hypot(*normal)
    side[np.abs(side) < EXACT] = 0.0
    following = np.roll(side, -1)
    share = np.where(side == 0.0, 0.0, side / np.where(side == following, 1.0, side - following))
    points = (shape + share[:, None] * (np.roll(shape, -1, axis=0) - shape)) @ onto_axis.T
    return [(i + share[i], points[i], mirror) for i in np.flatnonzero((side == 0.0) | (side * following < 0.0))]


def _repeated(points: np.ndarray, turn: np.ndarray, times: int) -> np.ndarray:
    return np.concatenate([points @ np.linalg.matrix_power(turn, i).T for i in range(times)])
