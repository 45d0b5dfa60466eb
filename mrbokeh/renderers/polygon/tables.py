"""Tables of polygon_differences: what depends on the aperture alone."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.kernels._vectors_numba import BLENDED_CELLS
from mrbokeh.renderers.polygon._ring_numba import SPARE_PX, Corners, Exact, Sums
from mrbokeh.renderers.polygon.crossings import CrossedCorners, crossed_corners, pair_of
from mrbokeh.renderers.polygon.directional_differences import Direction, PolygonCorners, edge_profile, polygon_corners
from mrbokeh.renderers.polygon.rectification import rectify_aperture
from mrbokeh.renderers.polygon.whole import whole_kernels

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
        """In a ring's precision, without steps and places, which depend on the ring."""
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
        """How far the light of a pixel of this diameter is splatted, at most."""
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
        corners, crossed_corners(corners, planes), planes, _sums(planes), exact, max(aperture.unit_radius, rectified.unit_radius)
    )


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


def _whole(numbers: Any) -> np.ndarray:
    return np.array(numbers, np.int64)


def _starts(lists: list[Any]) -> np.ndarray:
    return np.cumsum([0, *map(len, lists)])
