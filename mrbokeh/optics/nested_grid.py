"""A grid of few cells with a finer end: cells grow with their smallest coordinate (Leimkuehler et al. 2018, Section 5.2)."""

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from math import ceil, prod

import numpy as np
from jaxtyping import Float, Float64, Int64

from mrbokeh.system.errors import InputError


def triangular(level: Int64[np.ndarray, "*batch"] | int) -> Int64[np.ndarray, "*batch"]:
    """0, 1, 3, 6, 10, ...: where the cells of a level begin."""
    return np.asarray(level * (level + 1) // 2)


def triangular_root(steps: Float[np.ndarray, "*batch"]) -> Int64[np.ndarray, "*batch"]:
    """The largest level that begins at or below `steps` >= 0: floor((sqrt(8 s + 1) - 1) / 2), right at its jumps as well."""
    level = np.asarray((np.sqrt(8.0 * steps + 1.0) - 1.0) / 2.0).astype(np.int64)
    level = np.asarray(level - (triangular(level) > steps))
    return np.asarray(level + (triangular(np.asarray(level + 1)) <= steps))


@dataclass(frozen=True)
class NestedGrid:
    """Boxes that cover the unit cube once; which one holds a point is found without a search.

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
        """Where each level begins, in steps."""
        levels = int(triangular_root(np.array(min(self.counts) - 1.0))) + 1 if self.nested else 1
        return [int(triangular(level)) for level in range(levels)]

    def _shape(self, level: int) -> tuple[int, ...]:
        """Cells along each axis if the level were a full grid from its start to the end."""
        return tuple(ceil((count - self._starts[level]) / (level + 1)) for count in self.counts)

    def _faces(self, level: int) -> list[tuple[range, ...]]:
        """The cells of a level as blocks of lattice indices: block j has index 0 on axis j and none on the axes before."""
        shape = self._shape(level)
        if not self.nested:
            return [tuple(range(size) for size in shape)]
        return [tuple(range(min(i < j, size), 1 if i == j else size) for i, size in enumerate(shape)) for j in range(len(shape))]

    @cached_property
    def _first_cells(self) -> Int64[np.ndarray, " levels_and_end"]:
        """The inter-level index: how many cells lie on the levels before each level."""
        sizes = [sum(prod(map(len, face)) for face in self._faces(level)) for level in range(len(self._starts))]
        return np.cumsum([0, *sizes], dtype=np.int64)

    @cached_property
    def boxes(self) -> Float64[np.ndarray, "cells axes 2"]:
        """The backward map: low and high end of each cell on each axis, in unit coordinates."""
        cells = []
        for level, start in enumerate(self._starts):
            for lattice in (each for face in self._faces(level) for each in product(*face)):
                low = start + (level + 1) * np.array(lattice)
                cells.append(np.stack([low, np.minimum(low + level + 1, self.counts)], axis=1))
        return np.stack(cells) / np.array(self.counts, np.float64)[:, None]

    @cached_property
    def _tables(self) -> tuple[Int64[np.ndarray, " levels"], Int64[np.ndarray, "levels axes"], Int64[np.ndarray, "levels blocks"]]:
        """Starts, shapes and the index of the first cell of each block of each level."""
        levels = range(len(self._starts))
        shapes = np.array([self._shape(level) for level in levels], np.int64)
        sizes = [[prod(map(len, face)) for face in self._faces(level)] for level in levels]
        blocks = np.cumsum([[first, *row[:-1]] for first, row in zip(self._first_cells, sizes, strict=False)], axis=1, dtype=np.int64)
        return np.array(self._starts, np.int64), shapes, blocks

    def index_of(self, coords: Float[np.ndarray, "*batch axes"]) -> Int64[np.ndarray, "*batch"]:
        """The forward map: the cell that holds a point in unit coordinates; points outside belong to the nearest cell."""
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
        """First cell of the block plus the place in it, row by row; the block is that of the first axis with index 0."""
        axes = len(self.counts)
        face = np.asarray(np.argmin(lattice, axis=-1)) if self.nested else np.full(lattice.shape[:-1], -1, np.int64)
        place = np.zeros(lattice.shape[:-1], np.int64)
        for axis in range(axes):
            before = axis < face
            size = np.where(axis == face, 1, shape[..., axis] - before)
            place = place * size + np.where(axis == face, 0, lattice[..., axis] - before)
        first = np.take_along_axis(blocks, np.maximum(face, 0)[..., None], axis=-1)[..., 0]
        return np.asarray(first + place)
