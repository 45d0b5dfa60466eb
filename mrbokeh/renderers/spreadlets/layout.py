"""Where sums of points lie in the plane, and points laid out for them: in reals, or in whole numbers of 32 bits.

Whole numbers take half the memory of double precision, and what a pixel adds sums to 0 to the last bit, so that no error grows with
the picture. Their unit is as small as the brightest light and the points allow.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from mrbokeh.renderers.kernels.laplacian_integration import fast_width
from mrbokeh.renderers.kernels.laplacian_tables import Points

FOUR = 4  # LANES of the compiled loops
FAR_FIELD_PX = 8  # beyond the reach of the points, before the border on which light is 0
_BITS = 30  # and a sign; the one left over is for rounding
_LEAST_BOUND = 1e-25  # whose gain is still a number in single precision

Cells = Int32[np.ndarray, "height width"]


class Window(NamedTuple):
    """The part of the plane that light can reach: row and column of its first pixel, and its size."""

    top: int
    left: int
    height: int
    width: int

    def holds(self, other: "Window") -> bool:
        """Whether the other lies within."""
        begins = self.top <= other.top and self.left <= other.left
        return begins and other.top + other.height <= self.top + self.height and other.left + other.width <= self.left + self.width


def window_of(cells: Cells, reach_px: int, is_integrated: bool) -> Window:
    """What points of the pixels that have a cell (>= 0) reach, and for Laplacians the border on which light is 0."""
    rows, columns = (np.flatnonzero((cells >= 0).any(axis=axis)) for axis in (1, 0))
    margin = reach_px + (1 + FAR_FIELD_PX if is_integrated else 0)
    top, left = int(rows[0]) - margin, int(columns[0]) - margin
    height, width = int(rows[-1]) + margin + 1 - top, int(columns[-1]) + margin + 1 - left
    return Window(top, left, height, fast_width(width) if is_integrated else width)


class Laid(NamedTuple):
    """Points laid out for sums of a width: places in a flat array, weights, rows and apart as from `rows_of`.

    For sums in reals weights (N,) are in their precision; for whole numbers (N + 1,) the sums of the weights before each point of a
    cell, which are 0 before the first one and after the last.
    """

    offsets: Int32[np.ndarray, " points"]
    weights: Float[np.ndarray, " weights"]
    rows: Int32[np.ndarray, "cells rows"]
    apart: Bool[np.ndarray, " cells"]
    reach_px: int

    @classmethod
    def out(cls, points: Points, width: int, precision: type) -> "Laid":
        """precision: of the sums, numpy.int32 for whole numbers; their points must be of Laplacians, whose weights sum to 0."""
        from mrbokeh.renderers.spreadlets._splat_numba import rows_of

        offsets = (FOUR * (points.xy[:, 1] * width + points.xy[:, 0])).astype(np.int32)
        weights = _sums_before(points) if precision is np.int32 else points.weights.astype(precision)
        return cls(offsets, weights, *rows_of(points.xy, points.starts, points.reach_px), points.reach_px)


def gains_for(largest: Float32[np.ndarray, " channels"], points: Points) -> Float32[np.ndarray, " lanes"]:
    """Powers of two that make light, at most `largest` in each channel, as large as whole numbers can hold its sums."""
    from mrbokeh.renderers.spreadlets._whole_numba import largest_sum

    bound = np.zeros(FOUR)
    bound[: len(largest)] = largest
    bound *= largest_sum(points.xy, points.weights, points.reach_px)
    return np.ldexp(1.0, _BITS - np.frexp(np.maximum(bound, _LEAST_BOUND))[1]).astype(np.float32)


def _sums_before(points: Points) -> Float32[np.ndarray, " weights"]:
    sums = np.cumsum(points.weights) - points.weights
    sums -= np.repeat(sums[points.starts[:-1]], np.diff(points.starts))
    return np.append(sums, 0.0).astype(np.float32)
