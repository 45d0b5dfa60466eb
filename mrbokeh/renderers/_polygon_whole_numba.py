"""Pixels into the ring whose kernels need no sums: in focus, small kernels, and highlights."""

import math

import numpy as np

from mrbokeh._polygon_coverage_numba import fill_psf
from mrbokeh.renderers._polygon_ring_numba import ALIASED_ROWS, Exact, Ring, Scratch, compiled
from mrbokeh.renderers._polygon_vector_numba import add_to_cell, add_to_two_cells


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
def splat_small(
    values: np.ndarray, diameter_px: float, exact: Exact, ring: Ring, scratch: Scratch, row: int, y: int, x: int, share: float
) -> None:
    """A whole kernel, between the two of the table nearest in diameter."""
    at = (abs(diameter_px) - 1.0) * exact.per_px
    side = 0 if diameter_px > 0 else 1
    level = min(int(at), exact.radius.shape[0] - 1)
    radius = exact.radius[level]
    size = 2 * radius + 1
    start = exact.start[side, level]
    taps = scratch.taps[: size * size]
    _blend(taps, exact.lower[start:], exact.rise[start:], np.float32(at - level), np.float32(share))
    element = ring.planes.dtype.type
    value = (element(values[y, x, 0]), element(values[y, x, 1]), element(values[y, x, 2]), element(values[y, x, 3]))
    plane = ring.light_plane * ring.plane_elements
    for j in range(size):
        cell = plane + _cell(ring, row + j - radius, x - radius)
        _add_line(ring.planes, cell, taps, j * size, exact.span[side, level, j, 0], exact.span[side, level, j, 1], value)


@compiled
def _blend(taps: np.ndarray, lower: np.ndarray, rise: np.ndarray, upper: float, share: float) -> None:
    element = taps.dtype.type
    for i in range(taps.shape[0]):
        taps[i] = element(share * (lower[i] + upper * rise[i]))


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
