"""Grids over the coordinates of a bank of PSFs, whose cells each share one kernel: nested and proportional.

`NestedGrid` has few cells with a finer end: cells grow with their smallest coordinate (Leimkuehler et al. 2018, Section 5.2). If one
coordinate is small it takes small steps of both; mrbokeh.psf_models.build says what that costs.

`ProportionalGrid` covers two lengths in pixels with cells that grow in proportion to the kernels that they stand for. How much of a
kernel's light lies elsewhere after a small step depends on the step over the size of what changes. For a disc of diameter d, swept by a
motion m, that is d for a step of d, and the larger of d and m for a step of m (a motion much shorter than the disc only softens its rim).
So rows of equal steps of log(d + knee) have equal errors, and within a row steps of log(m + d + knee): many if the disc is small, few if
it is larger than all motion. The knee, some pixels, is where pixels blur more than steps do.
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import ceil, prod

import numpy as np
from jaxtyping import Float, Float64, Int64

from mrbokeh.system.errors import InputError


def triangular(level: Int64[np.ndarray, "*batch"] | int) -> Int64[np.ndarray, "*batch"]:
    """Return 0, 1, 3, 6, 10, ...: where the cells of a level begin."""
    return np.asarray(level * (level + 1) // 2)


def triangular_root(steps: Float[np.ndarray, "*batch"]) -> Int64[np.ndarray, "*batch"]:
    """Return the largest level that begins at or below `steps` >= 0: floor((sqrt(8 s + 1) - 1) / 2), right at its jumps as well."""
    level = np.asarray((np.sqrt(8.0 * steps + 1.0) - 1.0) / 2.0).astype(np.int64)
    level = np.asarray(level - (triangular(level) > steps))
    return np.asarray(level + (triangular(np.asarray(level + 1)) <= steps))


@dataclass(frozen=True)
class NestedGrid:
    """Grid of boxes that cover the unit cube once; the box that holds a point is found without a search.

    counts: steps of the underlying regular grid along each axis. Level l = 0, 1, 2, ... begins at the triangular number
    l (l + 1) / 2 on every axis, consists of cubes of edge l + 1 steps (cut off where the cube ends) and holds the points
    whose smallest coordinate lies in its first row of cubes.
    nested: False gives the regular grid itself, cells of one step.
    """

    counts: tuple[int, ...]
    nested: bool = True

    def __post_init__(self) -> None:
        if not self.counts or min(self.counts) < 1:
            raise InputError(f"a grid needs at least one step along each axis, got {self.counts}")

    def __len__(self) -> int:
        return int(self._first_cells[-1])

    @cached_property
    def _starts(self) -> list[int]:
        """Return where each level begins, in steps."""
        levels = int(triangular_root(np.array(min(self.counts) - 1.0))) + 1 if self.nested else 1
        return [int(triangular(level)) for level in range(levels)]

    def _shape(self, level: int) -> tuple[int, ...]:
        """Return the cells along each axis if the level were a full grid from its start to the end."""
        return tuple(ceil((count - self._starts[level]) / (level + 1)) for count in self.counts)

    def _faces(self, level: int) -> list[tuple[range, ...]]:
        """Return the cells of a level as blocks of lattice indices: block j has index 0 on axis j and none on the axes before."""
        shape = self._shape(level)
        if not self.nested:
            return [tuple(range(size) for size in shape)]
        return [tuple(range(min(i < j, size), 1 if i == j else size) for i, size in enumerate(shape)) for j in range(len(shape))]

    @cached_property
    def _first_cells(self) -> Int64[np.ndarray, " levels_and_end"]:
        """Return the inter-level index: how many cells lie on the levels before each level."""
        sizes = [sum(prod(map(len, face)) for face in self._faces(level)) for level in range(len(self._starts))]
        return np.cumsum([0, *sizes], dtype=np.int64)

    @cached_property
    def boxes(self) -> Float64[np.ndarray, "cells axes 2"]:
        """Return the low and high end of each cell on each axis, in unit coordinates: the backward map."""
        cells = []
        for level, start in enumerate(self._starts):
            for lattice in (each for face in self._faces(level) for each in product(*face)):
                low = start + (level + 1) * np.array(lattice)
                cells.append(np.stack([low, np.minimum(low + level + 1, self.counts)], axis=1))
        return np.stack(cells) / np.array(self.counts, np.float64)[:, None]

    @cached_property
    def _tables(self) -> tuple[Int64[np.ndarray, " levels"], Int64[np.ndarray, "levels axes"], Int64[np.ndarray, "levels blocks"]]:
        """Return starts, shapes and the index of the first cell of each block of each level."""
        levels = range(len(self._starts))
        shapes = np.array([self._shape(level) for level in levels], np.int64)
        sizes = [[prod(map(len, face)) for face in self._faces(level)] for level in levels]
        blocks = np.cumsum([[first, *row[:-1]] for first, row in zip(self._first_cells, sizes, strict=False)], axis=1, dtype=np.int64)
        return np.array(self._starts, np.int64), shapes, blocks

    def index_of(self, coords: Float[np.ndarray, "*batch axes"]) -> Int64[np.ndarray, "*batch"]:
        """Return the cell that holds a point in unit coordinates, the forward map; points outside belong to the nearest cell."""
        starts, shapes, blocks = self._tables
        unit = np.clip(np.asarray(coords, np.float64), 0.0, 1.0)
        steps = np.minimum(unit * self.counts, np.array(self.counts) - 0.5)
        level = triangular_root(np.asarray(steps.min(axis=-1))) if self.nested else np.zeros(steps.shape[:-1], np.int64)
        edge = level[..., None] + 1
        lattice = ((steps - starts[level][..., None]) / edge).astype(np.int64)
        return self._within(lattice, shapes[level], blocks[level])

    def _within(
        self, lattice: Int64[np.ndarray, "*batch axes"], shape: Int64[np.ndarray, "*batch axes"], blocks: Int64[np.ndarray, "*batch blocks"]
    ) -> Int64[np.ndarray, "*batch"]:
        """Return the first cell of the block plus the place in it, row by row; the block is that of the first axis with index 0."""
        axes = len(self.counts)
        face = np.asarray(np.argmin(lattice, axis=-1)) if self.nested else np.full(lattice.shape[:-1], -1, np.int64)
        place = np.zeros(lattice.shape[:-1], np.int64)
        for axis in range(axes):
            before = axis < face
            size = np.where(axis == face, 1, shape[..., axis] - before)
            place = place * size + np.where(axis == face, 0, lattice[..., axis] - before)
        first = np.take_along_axis(blocks, np.maximum(face, 0)[..., None], axis=-1)[..., 0]
        return np.asarray(first + place)


_ENOUGH = 1.2  # rounding may take finer rows back below the number of cells; not by more than this


@dataclass(frozen=True)
class ProportionalGrid:
    """Grid of boxes that cover the unit square once; the box that holds a point is found without a search.

    counts: rows along the first axis, and steps along the second one of the row that begins at 0; others get as many as keep
    steps alike. highs_px: what 1 means on either axis; both begin at 0. knee_px: see above.
    """

    counts: tuple[int, ...]
    highs_px: tuple[float, ...]
    knee_px: float

    def __post_init__(self) -> None:
        if len(self.counts) != 2 or len(self.highs_px) != 2 or min(self.counts) < 1:
            raise InputError(
                f"a proportional grid needs two ranges and at least one step along each, got {self.counts} over {self.highs_px} px"
            )
        if not (np.isfinite([self.knee_px, *self.highs_px]).all() and min(self.knee_px, *self.highs_px) > 0.0):
            raise InputError(f"a proportional grid needs ranges and a knee above 0, got {self.highs_px} and {self.knee_px} px")

    @classmethod
    def of_cells(cls, cells: int, highs_px: tuple[float, float], knee_px: float, step_ratio: float) -> "ProportionalGrid":
        """Return the finest grid of at most `cells` cells whose steps along the second axis are `step_ratio` times those of the first."""
        if cells < 1:
            raise InputError(f"a grid needs at least one cell, got {cells}")
        grid, rows = cls((1, 1), highs_px, knee_px), 1
        while rows <= cells:
            middle_px = 0.5 * float(_borders(rows, highs_px[0], knee_px)[1])
            wide = np.log1p(highs_px[1] / (knee_px + middle_px)) / np.log1p(highs_px[0] / knee_px)
            wanted = float(wide) * rows / step_ratio
            for columns in (int(wanted), int(wanted) + 1):
                finer = cls((rows, max(columns, 1)), highs_px, knee_px)
                grid = finer if len(grid) < len(finer) <= cells else grid
            if len(finer) > _ENOUGH * cells:
                break
            rows += 1
        return grid

    def __len__(self) -> int:
        return int(self.starts[-1])

    @cached_property
    def knees_px(self) -> Float64[np.ndarray, " rows"]:
        """Return the knee of the second axis in each row: that of the grid plus the row's middle."""
        borders = _borders(self.counts[0], self.highs_px[0], self.knee_px)
        return np.asarray(self.knee_px + 0.5 * (borders[:-1] + borders[1:]))

    @cached_property
    def steps(self) -> Int64[np.ndarray, " rows"]:
        """Return the number of cells of each row."""
        widths = np.log1p(self.highs_px[1] / self.knees_px)
        return np.maximum(np.rint(self.counts[1] * widths / widths[0]).astype(np.int64), 1)

    @cached_property
    def starts(self) -> Int64[np.ndarray, " rows_and_end"]:
        """Return the first cell of each row."""
        return np.concatenate([[0], np.cumsum(self.steps)])

    @cached_property
    def boxes(self) -> Float64[np.ndarray, "cells axes 2"]:
        """Return the low and high end of each cell on each axis, in unit coordinates."""
        rows = _borders(self.counts[0], self.highs_px[0], self.knee_px) / self.highs_px[0]
        cells = []
        for row, (steps, knee_px) in enumerate(zip(self.steps.tolist(), self.knees_px.tolist(), strict=True)):
            ends = _borders(steps, self.highs_px[1], knee_px) / self.highs_px[1]
            cells += [((rows[row], rows[row + 1]), (ends[step], ends[step + 1])) for step in range(steps)]
        return np.array(cells, np.float64)

    def index_of(self, coords: Float[np.ndarray, "*batch axes"]) -> Int64[np.ndarray, "*batch"]:
        """Return the cell that holds a point in unit coordinates; points outside belong to the nearest cell."""
        px = np.clip(np.asarray(coords, np.float64), 0.0, 1.0) * self.highs_px
        row = _step(px[..., 0], np.asarray(self.counts[0]), self.highs_px[0], np.asarray(self.knee_px))
        step = _step(px[..., 1], np.asarray(self.steps[row]), self.highs_px[1], np.asarray(self.knees_px[row]))
        return np.asarray(self.starts[row] + step)


def _borders(steps: int, high_px: float, knee_px: float) -> Float64[np.ndarray, " borders"]:
    """Return where equal steps of log(x + knee) from 0 to `high_px` begin and end."""
    borders = knee_px * np.expm1(np.linspace(0.0, 1.0, steps + 1) * np.log1p(high_px / knee_px))
    return np.append(borders[:-1], high_px)


def _step(
    px: Float64[np.ndarray, "*batch"], steps: Int64[np.ndarray, "*#batch"], high_px: float, knee_px: Float64[np.ndarray, "*#batch"]
) -> Int64[np.ndarray, "*batch"]:
    """Return which of the steps of `_borders` holds a length."""
    share = np.log1p(px / knee_px) / np.log1p(high_px / knee_px)
    return np.asarray(np.minimum((share * steps).astype(np.int64), steps - 1))
