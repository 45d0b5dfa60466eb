"""Tables of polygonal differences that depend on the aperture alone: its corners, the sums along directions, and whole kernels.

Corners go by the lattice points on which their edges' lines cross. Small kernels are splatted whole, by levels of diameter, as groups of
neighbouring taps.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt64

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.kernels._vectors_numba import BLENDED_CELLS
from mrbokeh.renderers.polygon._ring_numba import SPARE_PX, Corners, Exact, Sums
from mrbokeh.renderers.polygon.directional_differences import Direction, PolygonCorners, edge_profile, polygon_corners
from mrbokeh.renderers.polygon.rectification import rectify_aperture


@dataclass(frozen=True)
class CrossedCorner:
    """Corner whose four crossings lie at 0, step, step_after and their sum, lattice points in (x, y).

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

    @property
    def places(self) -> list[Direction]:
        """The crossings, in pairs as their weights are stored."""
        both = self.step[0] + self.step_after[0], self.step[1] + self.step_after[1]
        return [(0, 0), self.step, self.step_after, both] if self.kind == 0 else [self.step, self.step_after, (0, 0), both]


@dataclass(frozen=True)
class CrossedCorners:
    """Arrays over all CrossedCorner: steps (corners, 2, 2) and places (corners, 4, 2) in (x, y), turned (corners, 2);
    those of kind 0 come first, up to `level`, then those of kind 1, up to `steep`.
    """

    before: np.ndarray
    after: np.ndarray
    steps: np.ndarray
    places: np.ndarray
    plane: np.ndarray
    weight: np.ndarray
    turned: np.ndarray
    level: int
    steep: int

    @classmethod
    def of(cls, corners: list[CrossedCorner]) -> "CrossedCorners":
        return cls(
            before=_whole([corner.before for corner in corners]),
            after=_whole([corner.after for corner in corners]),
            steps=_whole([(corner.step, corner.step_after) for corner in corners]),
            places=_whole([corner.places for corner in corners]),
            plane=_whole([corner.plane for corner in corners]),
            weight=np.array([corner.weight for corner in corners]),
            turned=np.array([(corner.turned, corner.turned_after) for corner in corners]),
            level=sum(corner.kind == 0 for corner in corners),
            steep=sum(corner.kind <= 1 for corner in corners),
        )


def crossed_corners(corners: PolygonCorners, planes: dict[tuple[Direction, Direction], int]) -> CrossedCorners:
    """Return the corners with as many neighbouring crossings as they can have, the best kinds first."""
    found = []
    for before, after, weight in zip(corners.before, corners.after, corners.weight, strict=True):
        first, second = corners.direction[before], corners.direction[after]
        det = int(first[0] * second[1] - first[1] * second[0])
        step, step_after = (det * second[0], det * second[1]), (-det * first[0], -det * first[1])
        pair = pair_of(corners, before, after)
        corner = CrossedCorner(
            before=before,
            after=after,
            step=step,
            step_after=step_after,
            plane=planes[pair],
            weight=weight if pair == (first, second) else -weight,
        )
        found.append(min(corner.variants, key=lambda each: each.kind))
    return CrossedCorners.of(sorted(found, key=lambda corner: corner.kind))


def pair_of(corners: PolygonCorners, before: int, after: int) -> tuple[Direction, Direction]:
    first, second = sorted((corners.direction[before], corners.direction[after]))
    return first, second


def _whole(numbers: Any) -> np.ndarray:
    return np.array(numbers, np.int64)


LEVELS_PER_PX = 8.0
"""Small kernels are tabulated this densely in diameter; between two they are blended, which is 1e-3 of their peak off."""
_NOTHING = 1e-9
"""Below this a tap of a kernel is rounding."""

Groups = Int64[np.ndarray, "groups 4"]


def small_kernels(aperture: Aperture, to_px: float) -> Float32[np.ndarray, "2 kernels size size"]:
    """Return kernels of diameters from 1 px to at least `to_px`, LEVELS_PER_PX to a pixel, behind the focus and, turned, in front."""
    levels = int(np.ceil((to_px - 1.0) * LEVELS_PER_PX)) + 1
    behind = _stacked([aperture.rasterize(1.0 + level / LEVELS_PER_PX).kernel.astype(np.float32) for level in range(levels + 1)])
    return np.stack([behind, behind[:, ::-1, ::-1]])


def whole_kernels(aperture: Aperture, below_px: float) -> Exact:
    """Return kernels up to a little more than this diameter, behind the focus and, turned, in front, and the aperture for all others."""
    above_px = below_px * 7.0 / 6.0
    kernels = small_kernels(aperture, above_px)
    levels, radius = kernels.shape[1] - 1, kernels.shape[2] // 2
    low, high = kernels[:, :-1], kernels[:, 1:]
    groups, counts = _groups((np.abs(low) > _NOTHING) | (np.abs(high) > _NOTHING))
    row, column = _laid(groups, radius)
    vertices, starts, weights = aperture.packed()
    return Exact(
        lower=_taps(low, groups),
        rise=_taps(high - low, groups),
        row=row,
        column=column,
        start=np.cumsum([0, *counts]),
        levels=levels,
        radius=radius,
        per_px=LEVELS_PER_PX,
        from_px=below_px,
        to_px=above_px,
        vertices=vertices,
        starts=starts,
        weights=weights,
        unit_radius=aperture.unit_radius,
    )


def _stacked(kernels: Sequence[Float32[np.ndarray, "_ _"]]) -> Float32[np.ndarray, "kernels size size"]:
    """Stack kernels, each in the middle of as many pixels as the last, the largest, has."""
    stacked = np.zeros((len(kernels), *kernels[-1].shape), np.float32)
    for whole, kernel in zip(stacked, kernels, strict=True):
        border = (len(whole) - len(kernel)) // 2
        whole[border : border + len(kernel), border : border + len(kernel)] = kernel
    return stacked


def _groups(seen: Bool[np.ndarray, "turns levels size size"]) -> tuple[Groups, Int64[np.ndarray, " kernels"]]:
    """Return turn, level, row and first column of the groups of neighbours that cover the visible taps of each row, from first to
    last; and how many groups each kernel has.
    """
    first, last = seen.argmax(axis=3), seen.shape[3] - 1 - seen[..., ::-1].argmax(axis=3)
    of_row = np.where(seen.any(axis=3), (last - first) // BLENDED_CELLS + 1, 0)
    where = np.repeat(np.argwhere(of_row), of_row[of_row > 0], axis=0)
    before = np.arange(len(where)) - np.repeat(np.cumsum(of_row[of_row > 0]) - of_row[of_row > 0], of_row[of_row > 0])
    return np.column_stack([where, first[tuple(where.T)] + before * BLENDED_CELLS]), of_row.sum(axis=2).reshape(-1)


def _laid(groups: Groups, radius: int) -> tuple[UInt64[np.ndarray, " groups"], Int64[np.ndarray, " groups"]]:
    """Return rows from the first of the kernels on, and columns from the pixel's on, in numbers of four channels."""
    return groups[:, 2].astype(np.uint64), 4 * (groups[:, 3] - radius)


def _taps(kernels: Float32[np.ndarray, "turns levels size size"], groups: Groups) -> Float32[np.ndarray, " taps"]:
    """Return all taps of every group, 0 beyond the kernel."""
    padded = np.pad(kernels, ((0, 0), (0, 0), (0, 0), (0, BLENDED_CELLS - 1)))
    turn, level, row, column = groups.T
    return padded[turn[:, None], level[:, None], row[:, None], column[:, None] + np.arange(BLENDED_CELLS)].reshape(-1)


EDGE_STEPS = 0.75
"""By default the sums take over where the shortest edge of the outline is this many lattice steps long, ..."""
EXACT_BELOW_PX = (8.0, 16.0)
"""... but not at smaller or larger diameters than these: the first are cheaper whole, and from the second on 5 times dearer."""


@dataclass(frozen=True)
class ApertureTables:
    """An aperture as corners of its rectified polygons, as sums along directions, and as whole small kernels.

    crossed: the corners as they are splatted. planes: of each pair of directions that meets in a corner, by number. extent:
    farthest reach at radius 1.
    """

    corners: PolygonCorners
    crossed: CrossedCorners
    planes: dict[tuple[Direction, Direction], int]
    sums: Sums
    exact: Exact
    extent: float
    _laid: dict[np.dtype, Corners] = field(default_factory=dict, repr=False, compare=False)

    def corners_in(self, dtype: np.dtype) -> Corners:
        """Return the corners in a ring's precision, without steps and places, which depend on the ring."""
        if dtype not in self._laid:
            nowhere, corners, crossed = np.empty(0, np.int64), self.corners, self.crossed
            self._laid[dtype] = Corners(
                slope=corners.slope.astype(dtype),
                shift=corners.shift.astype(dtype),
                origin=corners.origin.astype(dtype),
                curvature=corners.curvature.astype(dtype),
                before=crossed.before,
                after=crossed.after,
                step=nowhere,
                turned=crossed.turned.astype(np.float64),
                plane=nowhere,
                place=nowhere,
                below=nowhere,
                weight=crossed.weight,
                level=crossed.level,
                steep=crossed.steep,
                area=corners.area[0],
                area_offset=corners.area[1],
                growth=corners.growth,
                extent=self.extent,
            )
        return self._laid[dtype]

    def margin_px(self, largest_px: float) -> int:
        """Return how far the light of a pixel of this diameter is splatted, at most."""
        grown = np.sqrt(0.25 * largest_px**2 + max(self.corners.growth, 0.0))
        return max(int(np.ceil(grown * self.extent)) + SPARE_PX, self.exact.radius + BLENDED_CELLS)


def tables_of(aperture: Aperture, directions: tuple[Direction, ...], max_edges: int, exact_below_px: float | None) -> ApertureTables:
    rectified = rectify_aperture(aperture, directions, max_edges)
    corners = polygon_corners(rectified, directions)
    planes: dict[tuple[Direction, Direction], int] = {}
    for before, after in zip(corners.before, corners.after, strict=True):
        planes.setdefault(pair_of(corners, before, after), len(planes))
    if exact_below_px is None:
        exact_below_px = float(np.clip(2.0 * EDGE_STEPS / corners.shortest, *EXACT_BELOW_PX))
    exact = whole_kernels(aperture, exact_below_px)
    return ApertureTables(
        corners=corners,
        crossed=crossed_corners(corners, planes),
        planes=planes,
        sums=_sums(planes),
        exact=exact,
        extent=max(aperture.unit_radius, rectified.unit_radius),
    )


def _sums(planes: dict[tuple[Direction, Direction], int]) -> Sums:
    """Return the sums along all directions. Corners of a pair in ascending order of directions
    count as they are, others negative (see `laid_out`).
    """
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
    """Return by how many cells sums along a direction are kept shifted: sums along directions to the left are kept so many cells to
    the left, so that profiles only look back.
    """
    return max(0, -direction[0])


def _profile(direction: Direction) -> list[tuple[int, int, float]]:
    """Return (columns back, rows back, weight), beginning with the place itself, then those of earlier rows."""
    taps = {(x + _shift(direction), y): weight for (x, y), weight in edge_profile(direction).items()}
    itself = taps.pop((0, 0), 0.0)
    rest = sorted(taps.items(), key=lambda tap: (tap[0][1] == 0, tap[0]))
    return [(0, 0, itself), *((x, y, weight) for (x, y), weight in rest)]


def _starts(lists: list[Any]) -> np.ndarray:
    return np.cumsum([0, *map(len, lists)])
