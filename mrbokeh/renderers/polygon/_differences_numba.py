"""One part of a picture through polygon_differences: splatted row by row into a ring, summed back as soon as rows are complete."""

import math

import numpy as np

from mrbokeh.renderers.polygon._aim_numba import CHUNK_PX
from mrbokeh.renderers.polygon._chunk_numba import splat_chunk
from mrbokeh.renderers.polygon._halves_numba import add_doubled_row
from mrbokeh.renderers.polygon._ring_numba import BLOCK_ROWS, SPARE_PX, Corners, Exact, Picture, Ring, Scratch, Sums, Target, compiled
from mrbokeh.renderers.polygon._sums_numba import add_row, cut_negative, finish_row


@compiled
def spread_parts(
    picture: Picture, corners: Corners, sums: Sums, exact: Exact, ring: Ring, scratch: Scratch, target: Target, parts: np.ndarray
) -> None:
    """Add the spread light of parts (N, 4) of a picture, each first row, end row, left, right, to the target, whose band holds the
    rows. The ring is empty before and after."""
    for k in range(parts.shape[0]):
        first, end, left, right = parts[k, 0], parts[k, 1], parts[k, 2], parts[k, 3]
        here = Ring(ring.planes, ring.plane_elements, ring.light_plane, ring.rows, ring.stride, ring.margin, left)
        _spread_part(picture, corners, sums, exact, here, scratch, target, first, end, right)


@compiled
def _spread_part(
    picture: Picture,
    corners: Corners,
    sums: Sums,
    exact: Exact,
    ring: Ring,
    scratch: Scratch,
    target: Target,
    first: int,
    end: int,
    right: int,
) -> None:
    reach = ring.margin
    blurred, lit = (end + reach, first - reach - 1), (end + reach, first - reach - 1)
    scratch.sums[:] = 0.0
    scratch.total[:] = 0.0
    for block in range(first, end, BLOCK_ROWS):
        block_end = min(block + BLOCK_ROWS, end)
        for left in range(ring.left, right, CHUNK_PX):
            for y in range(block, block_end):
                summed, whole = splat_chunk(picture, corners, exact, ring, scratch, y, left, min(left + CHUNK_PX, right))
                if summed > 0.0:
                    away = min(int(math.ceil(summed * corners.extent)) + SPARE_PX, reach)
                    blurred = (min(blurred[0], y - away), max(blurred[1], y + away))
                if whole > 0.0:
                    away = min(int(math.ceil(0.5 * whole * exact.unit_radius)), reach)
                    lit = (min(lit[0], y - away), max(lit[1], y + away))
        for y in range(block - reach, block_end - reach):
            finish_row(sums, ring, scratch, target, y, blurred, lit)
    for y in range(end - reach, end + reach):
        finish_row(sums, ring, scratch, target, y, blurred, lit)


@compiled
def settle(target: Target, strays: np.ndarray, starts: np.ndarray, half: np.ndarray, line: np.ndarray, nonnegative: np.ndarray) -> None:
    """Complete the rows of a band. strays (pieces, rows, 4 W): what other bands threw up and down, from rows `starts` on.
    half (rows, 4 cells): what was spread at half the resolution, or empty; line (4 cells) is scratch space."""
    for y in range(target.top, target.bottom):
        for piece in range(strays.shape[0]):
            if 0 <= y - starts[piece] < strays.shape[1]:
                add_row(target.out[y], strays[piece, y - starts[piece]])
        if half.shape[0] > 0:
            add_doubled_row(half, y, line, target.out[y])
        cut_negative(target.out[y], nonnegative)
