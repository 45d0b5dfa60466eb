"""Pixels into the ring whose kernels need no sums: in focus, small kernels, and highlights."""

import math

import numpy as np

from mrbokeh.optics._aperture_numba import fill_psf
from mrbokeh.renderers.kernels._vectors_numba import BLENDED_CELLS, add_to_cell, add_to_two_cells, blend_onto_cells, scaled
from mrbokeh.renderers.polygon._ring_numba import ALIASED_ROWS, APART_PX, Exact, Ring, Scratch, compiled


@compiled
def _cell(ring: Ring, row: int, x: int) -> int:
    """Where a plane holds column x of a row, which may lie before or after the ring proper."""
    around = ring.rows if row < 0 else (-ring.rows if row >= ring.rows else 0)
    return ((ALIASED_ROWS + row + around) * ring.stride + x - ring.left + ring.margin) * 4


@compiled
def keep(values: np.ndarray, ring: Ring, row: int, y: int, x: int) -> None:
    """A pixel in focus."""
    cell = ring.light_plane * ring.plane_elements + _cell(ring, row, x)
    for c in range(4):
        ring.planes[cell + c] += values[y, x, c]


@compiled
def splat_small(values: np.ndarray, coc_px: np.ndarray, exact: Exact, ring: Ring, scratch: Scratch, row: int, y: int, count: int) -> None:
    """The pixels of row y that scratch.small names, each the share of its light in scratch.small_share, by whole kernels."""
    plane, flat = ring.light_plane * ring.plane_elements, values.reshape(-1)
    for j in range(scratch.rows.shape[0]):
        scratch.rows[j] = plane + _cell(ring, row + j - exact.radius, 0)
    for start in range(min(APART_PX, count)):
        for i in range(start, count, APART_PX):
            x = np.int64(scratch.small[i])
            value = scaled(flat, 4 * (y * values.shape[1] + x), ring.planes.dtype.type(scratch.small_share[i]))
            _splat_small(coc_px[y, x], exact, ring, scratch.rows, 4 * x, value)


@compiled
def _splat_small(
    diameter_px: float, exact: Exact, ring: Ring, rows: np.ndarray, element: int, value: tuple[float, float, float, float]
) -> None:
    """A whole kernel, between the two of the table nearest in diameter."""
    at = (abs(diameter_px) - np.float32(1.0)) * np.float32(exact.per_px)
    level = min(int(at), exact.levels - 1)
    upper = at - np.float32(level)
    table = level if diameter_px > 0 else level + exact.levels
    for group in range(np.uint64(exact.start[table]), np.uint64(exact.start[table + 1])):
        cell = rows[exact.row[group]] + exact.column[group] + element
        blend_onto_cells(ring.planes, cell, exact.lower, exact.rise, BLENDED_CELLS * group, upper, value)


@compiled
def splat_exactly(
    values: np.ndarray, diameter_px: float, exact: Exact, ring: Ring, scratch: Scratch, row: int, y: int, x: int, share: float
) -> None:
    """A highlight, by the kernel of the aperture itself at its very diameter."""
    radius = max(0, int(math.ceil(abs(diameter_px) * 0.5 * exact.unit_radius - 0.5)))
    size = 2 * radius + 1
    kernel, steps = scratch.kernel[0, : size * size].reshape((size, size)), scratch.kernel[1, : size * size].reshape((size, size))
    fill_psf(kernel, steps, exact.vertices, exact.starts, exact.weights, diameter_px)
    element = ring.planes.dtype.type
    value = (element(values[y, x, 0]), element(values[y, x, 1]), element(values[y, x, 2]), element(values[y, x, 3]))
    plane = ring.light_plane * ring.plane_elements
    for j in range(size):
        cell = plane + _cell(ring, row + j - radius, x - radius)
        for i in range(size):
            scratch.taps[i] = element(share * kernel[j, i])
        _add_line(ring.planes, cell, scratch.taps, 0, 0, size, value)


@compiled
def _add_line(
    planes: np.ndarray, cell: int, taps: np.ndarray, start: int, first: int, end: int, value: tuple[float, float, float, float]
) -> None:
    """Taps first..end of a row of a kernel, which begins at taps[start], to the cells from `cell` on."""
    even = first + (end - first) // 2 * 2
    for i in range(first, even, 2):
        add_to_two_cells(planes, cell + 4 * i, taps, start + i, value)
    if even < end:
        add_to_cell(planes, cell + 4 * even, taps, start + even, value)
