"""Compiled loops of polygonal differences: parts of a picture are splatted row by row into a ring and summed back.

Rows are summed as soon as they are complete: along the directions, then downwards (Moroto et al. 2021, Eq. 9-11).
"""

import math

import numpy as np

from mrbokeh.renderers.kernels._vectors_numba import CHUNK_PX
from mrbokeh.renderers.polygon._halves_numba import add_doubled_row
from mrbokeh.renderers.polygon._ring_numba import (
    ALIASED_ROWS,
    BLOCK_ROWS,
    GUARD,
    SPARE_PX,
    Corners,
    Exact,
    Picture,
    Ring,
    Scratch,
    Sums,
    Target,
    compiled,
)
from mrbokeh.renderers.polygon._splat_numba import splat_chunk

FINISHED_PX = 128
"""Cells of a row of sums that are advanced together."""


@compiled
def splat_parts(
    picture: Picture, corners: Corners, sums: Sums, exact: Exact, ring: Ring, scratch: Scratch, target: Target, parts: np.ndarray
) -> None:
    """Add the blurred light of parts (N, 4) of a picture, each first row, end row, left, right, to the target, whose band holds the
    rows. The ring is empty before and after.
    """
    for k in range(parts.shape[0]):
        first, end, left, right = parts[k, 0], parts[k, 1], parts[k, 2], parts[k, 3]
        here = Ring(ring.planes, ring.plane_elements, ring.light_plane, ring.rows, ring.stride, ring.margin, left)
        _splat_part(picture, corners, sums, exact, here, scratch, target, first, end, right)


@compiled
def _splat_part(
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
    """Complete the rows of a band. strays (pieces, rows, 4 W): light of other bands thrown up and down, from rows `starts` on.
    half (rows, 4 cells): the light blurred at half the resolution, or empty; line (4 cells) is scratch space.
    """
    for y in range(target.top, target.bottom):
        for piece in range(strays.shape[0]):
            if 0 <= y - starts[piece] < strays.shape[1]:
                add_row(target.out[y], strays[piece, y - starts[piece]])
        if half.shape[0] > 0:
            add_doubled_row(half, y, line, target.out[y])
        cut_negative(target.out[y], nonnegative)


@compiled
def finish_row(sums: Sums, ring: Ring, scratch: Scratch, target: Target, y: int, blurred: tuple[int, int], lit: tuple[int, int]) -> None:
    """Complete row y, which has all its light: advance the sums if they are in use, write the row out and empty it.

    blurred and lit: the first and last row that pixels reach through the sums and without them.
    """
    is_blurred, is_lit = blurred[0] <= y <= blurred[1], lit[0] <= y <= lit[1]
    row = (y + ring.margin) % ring.rows
    here = (ALIASED_ROWS + row) * ring.stride * 4
    if is_blurred:
        _fold_aliases(ring, row)
    elif y == blurred[1] + 1:
        scratch.sums[:] = 0.0
        scratch.total[:] = 0.0
    if not (is_blurred or is_lit):
        return
    if y < 0 or y >= target.out.shape[0]:
        into = target.out[0, :0]
    elif y < target.top:
        into = target.above[y - target.top + target.above.shape[0]]
    elif y >= target.bottom:
        into = target.below[y - target.bottom]
    else:
        into = target.out[y]
    scratch.carry[:] = 0.0
    for start in range(0, ring.stride, FINISHED_PX):
        end = min(start + FINISHED_PX, ring.stride)
        if is_blurred and y < target.out.shape[0]:
            _advance(sums, ring, scratch, y, here, start, end)
        _write(ring, scratch.total, into, here, start, end, is_blurred)
        if start > 0:
            _clear(ring, here, start - FINISHED_PX, start, is_blurred)
    _clear(ring, here, (ring.stride - 1) // FINISHED_PX * FINISHED_PX, ring.stride, is_blurred)


@compiled
def _clear(ring: Ring, here: int, start: int, end: int, is_blurred: bool) -> None:
    for plane in range(0 if is_blurred else ring.light_plane, ring.light_plane + 1):
        at = plane * ring.plane_elements + here
        ring.planes[at + start * 4 : at + end * 4] = 0


@compiled
def _fold_aliases(ring: Ring, row: int) -> None:
    """Add the light in the row that stands for this one, before or after the ring proper."""
    if row < ALIASED_ROWS:
        alias = ALIASED_ROWS + ring.rows + row
    elif row >= ring.rows - ALIASED_ROWS:
        alias = row - (ring.rows - ALIASED_ROWS)
    else:
        return
    for plane in range(ring.light_plane):
        at = plane * ring.plane_elements + (ALIASED_ROWS + row) * ring.stride * 4
        other = plane * ring.plane_elements + alias * ring.stride * 4
        for i in range(ring.stride * 4):
            ring.planes[at + i] += ring.planes[other + i]
            ring.planes[other + i] = 0


@compiled
def _advance(sums: Sums, ring: Ring, scratch: Scratch, y: int, here: int, start: int, end: int) -> None:
    """Advance every sum along a direction, and the sum downwards, by one row; cells start..end of it.

    Inputs and parts of the profile beyond two are rare and added by themselves.
    """
    total = scratch.total[4 * start : 4 * end]
    for d in range(sums.step_x.shape[0]):
        slots = sums.step_y[d] + 1
        row, row_before = sums.row_start[d] + y % slots, sums.row_start[d] + (y - sums.step_y[d]) % slots
        elements = min(4 * end, 4 * (ring.stride - sums.shift[d])) - 4 * start
        from_ = GUARD + 4 * start
        current = scratch.sums[row, from_ : from_ + elements]
        first, last = sums.input_start[d], sums.input_start[d + 1] - 1
        at = here + 4 * (start + sums.shift[d])
        inputs = ring.planes[sums.input_plane[first] * ring.plane_elements + at :]
        others = ring.planes[sums.input_plane[last] * ring.plane_elements + at :]
        weights = (sums.input_weight[first], sums.input_weight[last] if last > first else 0.0)
        kept = 0.0
        if last - first > 1:
            kept = 1.0
            current[:] = 0.0
            for k in range(first + 1, last):
                _add_to(current, ring.planes[sums.input_plane[k] * ring.plane_elements + at :], sums.input_weight[k])
        tap = sums.profile_start[d]
        if sums.step_y[d] == 0:
            _sum_along_row(current, total, inputs, others, weights, kept, scratch.carry)
            continue
        previous = scratch.sums[row_before, from_ - 4 * sums.step_x[d] :]
        other_tap = scratch.sums[sums.row_start[d] + (y - sums.profile_y[tap + 1]) % slots, from_ - 4 * sums.profile_x[tap + 1] :]
        shares = (sums.profile_weight[tap], sums.profile_weight[tap + 1])
        _continue_sum(current, total, previous, other_tap, inputs, others, weights, shares, kept)
        for k in range(tap + 2, sums.profile_start[d + 1]):
            _add_to(
                total,
                scratch.sums[sums.row_start[d] + (y - sums.profile_y[k]) % slots, from_ - 4 * sums.profile_x[k] :],
                sums.profile_weight[k],
            )


@compiled
def _continue_sum(
    current: np.ndarray,
    total: np.ndarray,
    previous: np.ndarray,
    other_tap: np.ndarray,
    inputs: np.ndarray,
    others: np.ndarray,
    weights: tuple[float, float],
    shares: tuple[float, float],
    kept: float,
) -> None:
    for i in range(current.shape[0]):
        summed = previous[i] + (kept * current[i] + weights[0] * inputs[i] + weights[1] * others[i])
        current[i] = summed
        total[i] += shares[0] * summed + shares[1] * other_tap[i]


@compiled
def _add_to(target: np.ndarray, source: np.ndarray, weight: float) -> None:
    for i in range(target.shape[0]):
        target[i] += weight * source[i]


@compiled
def _sum_along_row(
    current: np.ndarray,
    total: np.ndarray,
    inputs: np.ndarray,
    others: np.ndarray,
    weights: tuple[float, float],
    kept: float,
    carry: np.ndarray,
) -> None:
    """Sum along the level direction, whose profile is one pixel high; `carry` takes the sum on to the next cells."""
    for i in range(current.shape[0]):
        current[i] = kept * current[i] + weights[0] * inputs[i] + weights[1] * others[i]
    a, b, c, d = carry[0], carry[1], carry[2], carry[3]
    for x in range(current.shape[0] // 4):
        i = 4 * x
        a += current[i]
        b += current[i + 1]
        c += current[i + 2]
        d += current[i + 3]
        total[i] += a
        total[i + 1] += b
        total[i + 2] += c
        total[i + 3] += d
    carry[0], carry[1], carry[2], carry[3] = a, b, c, d


@compiled
def _write(ring: Ring, total: np.ndarray, into: np.ndarray, here: int, start: int, end: int, is_blurred: bool) -> None:
    """Add cells of one row to the picture."""
    shift = ring.margin - ring.left
    first, last = 4 * max(start, shift), 4 * min(end, into.shape[0] // 4 + shift)
    if last <= first:
        return
    at = ring.light_plane * ring.plane_elements + here
    light, summed, row = ring.planes[at + first : at + last], total[first:last], into[first - 4 * shift : last - 4 * shift]
    if is_blurred:
        for i in range(row.shape[0]):
            row[i] += np.float32(summed[i] + light[i])
    else:
        for i in range(row.shape[0]):
            row[i] += np.float32(light[i])


@compiled
def add_row(row: np.ndarray, stray: np.ndarray) -> None:
    for i in range(row.shape[0]):
        row[i] += stray[i]


@compiled
def cut_negative(row: np.ndarray, nonnegative: np.ndarray) -> None:
    """Set values below 0 to 0 in channels that have no negative input: rounding, and dips beside the tips of a rectified outline."""
    zero = np.float32(0.0)
    if nonnegative.all():
        for i in range(row.shape[0]):
            row[i] = row[i] if row[i] > zero else zero
    elif nonnegative.any():
        for i in range(row.shape[0]):
            row[i] = zero if nonnegative[i % 4] and row[i] < zero else row[i]
