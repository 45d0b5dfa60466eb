"""Pixels into the ring as impulses at the corners of their kernels."""

import numpy as np

from mrbokeh.renderers.kernels._vectors_numba import add_to_cell, add_to_two_cells, fetch, one_by_one, scaled
from mrbokeh.renderers.polygon._aim_numba import AIM_PX, CHUNK_PX, aim_level, aim_steep
from mrbokeh.renderers.polygon._ring_numba import ALIASED_ROWS, APART_PX, Corners, Ring, Scratch, compiled

CELLS_OF_LINE = 4
"""Cells of four numbers in single precision that share a line of the cache."""


@compiled
def splat_corners(values: np.ndarray, corners: Corners, ring: Ring, scratch: Scratch, y: int, row: int, count: int) -> None:
    """The pixels of row y that scratch.element, radius and gain name, into the ring at `row`."""
    _prepare(corners, scratch, count)
    _aim(corners, ring, scratch, row, count)
    _splat(values, corners, ring, scratch, y, count)


@compiled
def _prepare(corners: Corners, scratch: Scratch, count: int) -> None:
    """Of every pixel and edge the lattice line above it and the share of the next one; then the gain to an exact sum of 1."""
    real = scratch.share.dtype.type
    one, area = real(1.0), scratch.gain[CHUNK_PX : 2 * CHUNK_PX]
    of_square, offset_of_area = real(corners.area), real(corners.area_offset)
    for i in range(count):
        area[i] = of_square * scratch.radius[i] * scratch.radius[i] + offset_of_area
    for edge in range(corners.slope.shape[0]):
        slope, shift, origin, curvature = corners.slope[edge], corners.shift[edge], corners.origin[edge], corners.curvature[edge]
        lines, shares = scratch.line[edge * CHUNK_PX :], scratch.share[edge * CHUNK_PX :]
        for i in range(count):
            offset = slope * scratch.radius[i] + (origin + (shift if scratch.radius[i] > 0 else -shift))
            line = np.floor(offset)
            share = offset - line
            area[i] += curvature * share * (one - share)
            lines[i] = np.int32(line)
            shares[i] = share
    for i in range(count):
        scratch.gain[i] /= area[i]


@compiled
def _aim(corners: Corners, ring: Ring, scratch: Scratch, row: int, count: int) -> None:
    """Of every pixel and corner the first of the four crossings, as an element of the ring, and the weights of all four."""
    here = np.int32((row * ring.stride + ring.margin - ring.left) * 4)
    around = np.int32(ring.rows * ring.stride * 4)
    element = ring.planes.dtype.type
    one, two = element(1.0), element(2.0)
    for corner in range(corners.before.shape[0]):
        plane = np.int32(ALIASED_ROWS * ring.stride * 4 + corners.plane[corner])
        steps = (here, np.int32(corners.step[corner, 0]), np.int32(corners.step[corner, 1]), plane, around)
        turned, turned_after = element(corners.turned[corner, 0]), element(corners.turned[corner, 1])
        signs = (element(corners.weight[corner]), turned, one - two * turned, turned_after, one - two * turned_after)
        before, after = corners.before[corner] * CHUNK_PX, corners.after[corner] * CHUNK_PX
        for i in range(0, count, AIM_PX):
            places = (i, corner * CHUNK_PX, 4 * corner * CHUNK_PX, before, after)
            if corner < corners.level:
                aim_level(scratch.target, scratch.weight, scratch.element, scratch.line, scratch.share, places, steps, signs)
            else:
                aim_steep(scratch.target, scratch.weight, scratch.element, scratch.line, scratch.share, places, steps, signs)


@compiled
def _splat(values: np.ndarray, corners: Corners, ring: Ring, scratch: Scratch, y: int, count: int) -> None:
    """Every corner's impulse, on the four crossings of its edges' lattice lines."""
    element, flat = ring.planes.dtype.type, values.reshape(-1)
    first_of_row = y * values.shape[1] * 4
    for start in range(min(APART_PX, count)):
        for i in range(start, count, APART_PX):
            if i % CELLS_OF_LINE == 0:
                _fetch_below(corners, ring, scratch, i)
            value = scaled(flat, first_of_row + scratch.element[i], element(scratch.gain[i]))
            _splat_pixel(corners, ring, scratch, i, value)


@compiled
def _fetch_below(corners: Corners, ring: Ring, scratch: Scratch, i: int) -> None:
    """Have what the pixel below will need and this one does not: caches do not foresee corners of kernels."""
    for corner in range(corners.below.shape[0]):
        fetch(ring.planes, np.int64(scratch.target[np.uint64(corner * CHUNK_PX + i)]) + corners.below[corner])


@compiled
def _splat_pixel(corners: Corners, ring: Ring, scratch: Scratch, i: int, value: tuple[float, float, float, float]) -> None:
    planes, weights, places = ring.planes, scratch.weight, corners.place
    for corner in range(corners.level):
        one_by_one()
        at = np.int64(scratch.target[np.uint64(corner * CHUNK_PX + i)])
        weight = 4 * corner * CHUNK_PX + 2 * i
        add_to_two_cells(planes, at + places[corner, 0], weights, weight, value)
        add_to_two_cells(planes, at + places[corner, 2], weights, weight + 2 * CHUNK_PX, value)
    for corner in range(corners.level, corners.steep):
        one_by_one()
        at = np.int64(scratch.target[np.uint64(corner * CHUNK_PX + i)])
        weight = 4 * corner * CHUNK_PX + 2 * i
        add_to_two_cells(planes, at + places[corner, 0], weights, weight, value)
        add_to_cell(planes, at + places[corner, 2], weights, weight + 2 * CHUNK_PX, value)
        add_to_cell(planes, at + places[corner, 3], weights, weight + 2 * CHUNK_PX + 1, value)
    for corner in range(corners.steep, corners.before.shape[0]):
        one_by_one()
        at = np.int64(scratch.target[np.uint64(corner * CHUNK_PX + i)])
        weight = 4 * corner * CHUNK_PX + 2 * i
        for k in range(4):
            add_to_cell(planes, at + places[corner, k], weights, weight + 2 * CHUNK_PX * (k // 2) + k % 2, value)
