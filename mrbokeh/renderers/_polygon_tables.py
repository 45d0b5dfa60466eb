"""Tables of polygon_differences: what depends on the aperture alone, and what on the size of the ring of rows."""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np

from mrbokeh.aperture import Aperture
from mrbokeh.directional_differences import Direction, PolygonCorners, edge_profile, polygon_corners
from mrbokeh.polygon_rectification import rectify_aperture
from mrbokeh.renderers._polygon_aim_numba import CHUNK_PX
from mrbokeh.renderers._polygon_ring_numba import (
    ALIASED_ROWS,
    BLOCK_ROWS,
    GUARD,
    SPARE_PX,
    Corners,
    Exact,
    Ring,
    Scratch,
    Sums,
)

LEVELS_PER_PX = 8.0
"""Small kernels are tabulated this densely in diameter; between two they are blended, which is 1e-3 of their peak off."""
_NOTHING = 1e-9
"""Below this a tap of a kernel is rounding."""
EDGE_STEPS = 0.75
"""By default the sums take over where the shortest edge of the outline is this many lattice steps long, ..."""
EXACT_BELOW_PX = (8.0, 16.0)
"""... but not at smaller or larger diameters than these: the first are cheaper whole, and from the second on 5 times dearer."""


@dataclass(frozen=True)
class CrossedCorner:
    """A corner whose four crossings lie at 0, step, step_after and their sum, lattice points in (x, y).

    turned, turned_after: whether the two lines of that edge count backwards, from the one farther along its step.
    """

    before: int
    after: int
    step: Direction
    step_after: Direction
    plane: int
    weight: float
    turned: bool = False
    turned_after: bool = False

    @property
    def kind(self) -> int:
        """0: crossings 0 and 1 are neighbours in a row, as are 2 and 3; 1: crossings 1 and 2 are; 2: none are."""
        if self.step == (1, 0):
            return 0
        return 1 if (self.step_after[0] - self.step[0], self.step_after[1] - self.step[1]) == (1, 0) else 2

    @property
    def variants(self) -> "Iterator[CrossedCorner]":
        """The same corner with its edges named the other way round, and with lines counted backwards."""
        other = replace(self, before=self.after, after=self.before, step=self.step_after, step_after=self.step)
        for corner in (self, other):
            step, step_after = ((-x, -y) for x, y in (corner.step, corner.step_after))
            yield corner
            yield replace(corner, step=step, turned=True)
            yield replace(corner, step_after=step_after, turned_after=True)
            yield replace(corner, step=step, turned=True, step_after=step_after, turned_after=True)

    def places(self, stride: int) -> list[int]:
        step, step_after = (4 * (y * stride + x) for x, y in (self.step, self.step_after))
        return [0, step, step_after, step + step_after] if self.kind == 0 else [step, step_after, 0, step + step_after]


@dataclass(frozen=True)
class ApertureTables:
    """An aperture as corners of its rectified polygons, as sums along directions, and as whole small kernels.

    crossed: the corners as they are splatted. planes: of each pair of directions that meets in a corner, by number. extent:
    farthest reach at radius 1.
    """

    corners: PolygonCorners
    crossed: list[CrossedCorner]
    planes: dict[tuple[Direction, Direction], int]
    sums: Sums
    exact: Exact
    extent: float

    def margin_px(self, largest_px: float) -> int:
        """How far the light of a pixel of this diameter is splatted, at most."""
        grown = np.sqrt(0.25 * largest_px**2 + max(self.corners.growth, 0.0))
        return max(int(np.ceil(grown * self.extent)) + SPARE_PX, int(self.exact.radius[-1]) + 1)


def tables_of(aperture: Aperture, directions: tuple[Direction, ...], max_edges: int, exact_below_px: float | None) -> ApertureTables:
    rectified = rectify_aperture(aperture, directions, max_edges)
    corners = polygon_corners(rectified, directions)
    planes: dict[tuple[Direction, Direction], int] = {}
    for before, after in zip(corners.before, corners.after, strict=True):
        planes.setdefault(_pair(corners, before, after), len(planes))
    if exact_below_px is None:
        exact_below_px = float(np.clip(2.0 * EDGE_STEPS / corners.shortest, *EXACT_BELOW_PX))
    exact = _exact(aperture, exact_below_px)
    return ApertureTables(
        corners, _crossed(corners, planes), planes, _sums(planes), exact, max(aperture.unit_radius, rectified.unit_radius)
    )


def _crossed(corners: PolygonCorners, planes: dict[tuple[Direction, Direction], int]) -> list[CrossedCorner]:
    """Corners with as many neighbouring crossings as they have, the best kinds first."""
    found = []
    for before, after, weight in zip(corners.before, corners.after, corners.weight, strict=True):
        first, second = corners.direction[before], corners.direction[after]
        det = int(first[0] * second[1] - first[1] * second[0])
        step, step_after = (det * second[0], det * second[1]), (-det * first[0], -det * first[1])
        pair = _pair(corners, before, after)
        corner = CrossedCorner(before, after, step, step_after, planes[pair], weight if pair == (first, second) else -weight)
        found.append(min(corner.variants, key=lambda each: each.kind))
    return sorted(found, key=lambda corner: corner.kind)


def _pair(corners: PolygonCorners, before: int, after: int) -> tuple[Direction, Direction]:
    first, second = sorted((corners.direction[before], corners.direction[after]))
    return first, second


def _sums(planes: dict[tuple[Direction, Direction], int]) -> Sums:
    """Corners of a pair in ascending order of directions count as they are, others negative (see `laid_out`)."""
    directions = sorted({direction for pair in planes for direction in pair if direction[0]})
    inputs: list[list[tuple[int, float]]] = []
    profiles: list[list[tuple[int, int, float]]] = []
    for direction in directions:
        run = 1.0 if direction[0] > 0 else -1.0
        feeds = ((plane, run if pair[1] == direction else -run) for pair, plane in planes.items() if direction in pair)
        inputs.append(list(feeds))
        profiles.append(_profile(direction))
    flat_inputs = [each for feeds in inputs for each in feeds]
    flat_profiles = [each for profile in profiles for each in profile]
    return Sums(
        step_x=_whole([dx for dx, _ in directions]),
        step_y=_whole([dy for _, dy in directions]),
        shift=_whole([_shift(direction) for direction in directions]),
        input_start=_starts(inputs),
        input_plane=_whole([plane for plane, _ in flat_inputs]),
        input_weight=np.array([weight for _, weight in flat_inputs]),
        profile_start=_starts(profiles),
        profile_x=_whole([x for x, _, _ in flat_profiles]),
        profile_y=_whole([y for _, y, _ in flat_profiles]),
        profile_weight=np.array([weight for _, _, weight in flat_profiles]),
        row_start=np.cumsum([0, *(dy + 1 for _, dy in directions)]),
    )


def _shift(direction: Direction) -> int:
    """Sums along directions to the left are kept so many cells to the left, so that profiles only look back."""
    return max(0, -direction[0])


def _profile(direction: Direction) -> list[tuple[int, int, float]]:
    """(columns back, rows back, weight), beginning with the place itself, then those of earlier rows."""
    taps = {(x + _shift(direction), y): weight for (x, y), weight in edge_profile(direction).items()}
    itself = taps.pop((0, 0), 0.0)
    rest = sorted(taps.items(), key=lambda tap: (tap[0][1] == 0, tap[0]))
    return [(0, 0, itself), *((x, y, weight) for (x, y), weight in rest)]


def _exact(aperture: Aperture, below_px: float) -> Exact:
    above_px = below_px * 7.0 / 6.0
    levels = int(np.ceil((above_px - 1.0) * LEVELS_PER_PX)) + 1
    kernels = [aperture.rasterize(1.0 + level / LEVELS_PER_PX).kernel for level in range(levels + 1)]
    radii = _whole([kernel.shape[0] // 2 for kernel in kernels[1:]])
    starts = np.cumsum(np.concatenate([[0], np.tile((2 * radii + 1) ** 2, 2)]))[:-1].reshape(2, levels)
    lower, rise = [], []
    spans = np.zeros((2, levels, 2 * int(radii[-1]) + 1, 2), np.int64)
    for side, turn in enumerate((1, -1)):
        for level, (low, high) in enumerate(pairwise(kernels)):
            low, high = np.pad(low, (high.shape[0] - low.shape[0]) // 2)[::turn, ::turn], high[::turn, ::turn]
            lower.append(low.astype(np.float32).reshape(-1))
            rise.append((high - low).astype(np.float32).reshape(-1))
            for row, seen in enumerate(np.maximum(np.abs(low), np.abs(high)) > _NOTHING):
                columns = np.flatnonzero(seen)
                spans[side, level, row] = (columns[0], columns[-1] + 1) if columns.size else (0, 0)
    tables = np.concatenate(lower), np.concatenate(rise), starts, spans, radii
    return Exact(*tables, LEVELS_PER_PX, below_px, above_px, *aperture.packed(), aperture.unit_radius)


def ring_of(tables: ApertureTables, margin: int, width: int, planes: np.ndarray) -> Ring:
    """A ring for parts of a picture of at most this width, in `planes`: at least `ring_elements` zeros."""
    rows, stride = 2 * margin + BLOCK_ROWS, width + 2 * margin
    return Ring(planes, (rows + 2 * ALIASED_ROWS) * stride * 4, len(tables.planes), rows, stride, margin, 0)


def ring_elements(tables: ApertureTables, margin: int, width: int) -> int:
    return (len(tables.planes) + 1) * (2 * margin + BLOCK_ROWS + 2 * ALIASED_ROWS) * (width + 2 * margin) * 4


def laid_out(tables: ApertureTables, ring: Ring) -> Corners:
    """Lines count forwards here; crossing 0 of a corner that is turned lies one line on, one step back."""
    corners, crossed = tables.corners, tables.crossed
    steps = 4 * np.array([[y * ring.stride + x for x, y in (corner.step, corner.step_after)] for corner in crossed])
    turned = np.array([(corner.turned, corner.turned_after) for corner in crossed])
    return Corners(
        slope=corners.slope.astype(ring.planes.dtype),
        shift=corners.shift.astype(ring.planes.dtype),
        origin=corners.origin.astype(ring.planes.dtype),
        curvature=corners.curvature.astype(ring.planes.dtype),
        before=_whole([corner.before for corner in crossed]),
        after=_whole([corner.after for corner in crossed]),
        step=np.where(turned, -steps, steps),
        turned=turned.astype(np.float64),
        plane=_whole([corner.plane * ring.plane_elements for corner in crossed]) - (turned * steps).sum(axis=1),
        place=_whole([corner.places(ring.stride) for corner in crossed]),
        below=_whole([max(corner.places(ring.stride)) + 4 * ring.stride for corner in crossed]),
        weight=np.array([corner.weight for corner in crossed]),
        level=sum(corner.kind == 0 for corner in crossed),
        steep=sum(corner.kind <= 1 for corner in crossed),
        area=corners.area[0],
        area_offset=corners.area[1],
        growth=corners.growth,
        extent=tables.extent,
    )


def scratch_of(tables: ApertureTables, ring: Ring) -> Scratch:
    edges, corners = len(tables.corners.slope), len(tables.corners.weight)
    dtype = ring.planes.dtype
    return Scratch(
        element=np.zeros(CHUNK_PX, np.int32),
        radius=np.zeros(CHUNK_PX, dtype),
        gain=np.zeros(2 * CHUNK_PX, dtype),
        line=np.zeros(edges * CHUNK_PX, np.int32),
        share=np.zeros(edges * CHUNK_PX, dtype),
        target=np.zeros((corners + 1) * CHUNK_PX, np.int32),
        weight=np.zeros(4 * corners * CHUNK_PX, dtype),
        sums=np.zeros((int(tables.sums.row_start[-1]), 4 * ring.stride + 2 * GUARD)),
        total=np.zeros(4 * ring.stride),
        carry=np.zeros(4),
        taps=np.zeros(max((2 * int(tables.exact.radius[-1]) + 1) ** 2, 2 * ring.margin + 1), dtype),
        kernel=np.zeros((2, (2 * ring.margin + 1) ** 2)),
    )


def _whole(numbers: Any) -> np.ndarray:
    return np.array(numbers, np.int64)


def _starts(lists: list[Any]) -> np.ndarray:
    return np.cumsum([0, *map(len, lists)])
