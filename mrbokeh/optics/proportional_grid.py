"""A grid over two lengths in pixels whose cells grow in proportion to the kernels that they stand for.

How much of a kernel's light lies elsewhere after a small step depends on the step over the size of what changes. For a disc of
diameter d, swept by a motion m, that is d for a step of d, and the larger of d and m for a step of m (a motion much shorter than
the disc only softens its rim). So rows of equal steps of log(d + knee) have equal errors, and within a row steps of
log(m + d + knee): many where the disc is small, few where it is larger than all motion. The knee, some pixels, is where
pixels blur more than steps do.

The nested grid of Leimkuehler et al. 2018 (mrbokeh.optics.nested_grid) grows with the smaller coordinate; where one is small it takes
small steps of both. mrbokeh.psf_models.combined says what that costs.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, Float64, Int64

from mrbokeh.system.errors import InputError

_ENOUGH = 1.2  # rounding may take finer rows back below the number of cells; not by more than this


@dataclass(frozen=True)
class ProportionalGrid:
    """Boxes that cover the unit square once; which one holds a point is found without a search.

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
        """The finest with at most so many cells whose steps along the second axis are `step_ratio` times those along the first."""
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
        """The knee of the second axis in each row: that of the grid and the row's middle."""
        borders = _borders(self.counts[0], self.highs_px[0], self.knee_px)
        return np.asarray(self.knee_px + 0.5 * (borders[:-1] + borders[1:]))

    @cached_property
    def steps(self) -> Int64[np.ndarray, " rows"]:
        """Cells of each row."""
        widths = np.log1p(self.highs_px[1] / self.knees_px)
        return np.maximum(np.rint(self.counts[1] * widths / widths[0]).astype(np.int64), 1)

    @cached_property
    def starts(self) -> Int64[np.ndarray, " rows_and_end"]:
        """The first cell of each row."""
        return np.concatenate([[0], np.cumsum(self.steps)])

    @cached_property
    def boxes(self) -> Float64[np.ndarray, "cells axes 2"]:
        """Low and high end of each cell on each axis, in unit coordinates."""
        rows = _borders(self.counts[0], self.highs_px[0], self.knee_px) / self.highs_px[0]
        cells = []
        for row, (steps, knee_px) in enumerate(zip(self.steps.tolist(), self.knees_px.tolist(), strict=True)):
            ends = _borders(steps, self.highs_px[1], knee_px) / self.highs_px[1]
            cells += [((rows[row], rows[row + 1]), (ends[step], ends[step + 1])) for step in range(steps)]
        return np.array(cells, np.float64)

    def index_of(self, coords: Float[np.ndarray, "*batch axes"]) -> Int64[np.ndarray, "*batch"]:
        """The cell that holds a point in unit coordinates; points outside belong to the nearest cell."""
        px = np.clip(np.asarray(coords, np.float64), 0.0, 1.0) * self.highs_px
        row = _step(px[..., 0], np.asarray(self.counts[0]), self.highs_px[0], np.asarray(self.knee_px))
        step = _step(px[..., 1], np.asarray(self.steps[row]), self.highs_px[1], np.asarray(self.knees_px[row]))
        return np.asarray(self.starts[row] + step)


def _borders(steps: int, high_px: float, knee_px: float) -> Float64[np.ndarray, " borders"]:
    """Where equal steps of log(x + knee) from 0 to `high_px` begin and end."""
    borders = knee_px * np.expm1(np.linspace(0.0, 1.0, steps + 1) * np.log1p(high_px / knee_px))
    return np.append(borders[:-1], high_px)


def _step(
    px: Float64[np.ndarray, "*batch"], steps: Int64[np.ndarray, "*#batch"], high_px: float, knee_px: Float64[np.ndarray, "*#batch"]
) -> Int64[np.ndarray, "*batch"]:
    """Which of `_borders`' steps holds a length."""
    share = np.log1p(px / knee_px) / np.log1p(high_px / knee_px)
    return np.asarray(np.minimum((share * steps).astype(np.int64), steps - 1))
