"""Pixels into the ring: impulses at the corners of their kernels, or small and exact kernels whole."""

import math

import numpy as np

from mrbokeh._polygon_coverage_numba import fill_psf
from mrbokeh.renderers._polygon_ring_numba import ALIASED_ROWS, Corners, Exact, Picture, Ring, Scratch, compiled
from mrbokeh.renderers._polygon_vector_numba import AIM_PX, CHUNK_PX, add_at_crossings, add_scaled, aim_at_crossings, fetch

AHEAD_PX = 8
"""How many pixels before its splat a cell is asked for: caches do not foresee corners of kernels."""


@compiled
def splat_chunk(
    picture: Picture, corners: Corners, exact: Exact, ring: Ring, scratch: Scratch, y: int, left: int, right: int
) -> tuple[float, float]:
    """Sort the pixels of a piece of a row by size and splat them; the largest radius that went through the sums and the
    largest diameter that did not, both 0 if there was none."""
    values, coc_px = picture.values, picture.coc_px
    count, largest, whole = 0, 0.0, np.float32(0.0)
    row = (y + ring.margin) % ring.rows
    per_share = 1.0 / (exact.to_px - exact.from_px)
    for x in range(left, right):
        if values[y, x, 0] == 0 and values[y, x, 1] == 0 and values[y, x, 2] == 0 and values[y, x, 3] == 0:
            continue
        size = abs(coc_px[y, x])
        summed = 1.0
        if size < exact.to_px:
            summed = max((size - exact.from_px) * per_share, 0.0)
            whole = max(whole, max(size, np.float32(1.0)))
            if size <= np.float32(1.0):
                _keep(values, ring, row, y, x)
            else:
                _splat_small(values, coc_px[y, x], exact, ring, scratch, row, y, x, 1.0 - summed)
        if summed > 0.0 and picture.share.shape[0] > 0 and picture.share[y, x] > 0:
            _splat_exactly(values, coc_px[y, x], exact, ring, scratch, row, y, x, summed * picture.share[y, x])
            summed *= 1.0 - picture.share[y, x]
            whole = max(whole, size)
        if summed > 0.0:
            scratch.element[count] = np.int32(4 * x)
            radius = math.sqrt(0.25 * float(size) * size + corners.growth)
            largest = max(largest, radius)
            scratch.radius[count] = math.copysign(radius, coc_px[y, x])
            scratch.gain[count] = summed
            count += 1
    if count:
        _prepare(corners, scratch, count)
        _aim(corners, ring, scratch, row, count)
        _splat_corners(values, corners, ring, scratch, y, count)
    return largest, float(whole)


@compiled
def _cell(ring: Ring, row: int, x: int) -> int:
    """Where a plane holds column x of a row, which may lie before or after the ring proper."""
    around = ring.rows if row < 0 else (-ring.rows if row >= ring.rows else 0)
    return ((ALIASED_ROWS + row + around) * ring.stride + x - ring.left + ring.margin) * 4


@compiled
def _keep(values: np.ndarray, ring: Ring, row: int, y: int, x: int) -> None:
    """A pixel in focus."""
    cell = ring.light_plane * ring.plane_elements + _cell(ring, row, x)
    for c in range(4):
        ring.planes[cell + c] += values[y, x, c]


@compiled
def _splat_small(
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
        weights = taps[j * size : (j + 1) * size]
        for i in range(exact.span[side, level, j, 0], exact.span[side, level, j, 1]):
            add_scaled(ring.planes, cell + 4 * i, weights[np.uint64(i)], value)


@compiled
def _blend(taps: np.ndarray, lower: np.ndarray, rise: np.ndarray, upper: float, share: float) -> None:
    element = taps.dtype.type
    for i in range(taps.shape[0]):
        taps[i] = element(share * (lower[i] + upper * rise[i]))


@compiled
def _splat_exactly(
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
            add_scaled(ring.planes, cell + 4 * i, element(share * kernel[j, i]), value)


@compiled
def _prepare(corners: Corners, scratch: Scratch, count: int) -> None:
    """Of every pixel and edge the lattice line above it and the share of the next one; then the gain to an exact sum of 1."""
    element = scratch.share.dtype.type
    area = scratch.gain[CHUNK_PX : 2 * CHUNK_PX]
    for i in range(count):
        area[i] = corners.area * scratch.radius[i] * scratch.radius[i] + corners.area_offset
    for edge in range(corners.slope.shape[0]):
        slope, shift, origin, curvature = corners.slope[edge], corners.shift[edge], corners.origin[edge], corners.curvature[edge]
        lines, shares = scratch.line[edge * CHUNK_PX :], scratch.share[edge * CHUNK_PX :]
        for i in range(count):
            offset = slope * scratch.radius[i] + (origin + (shift if scratch.radius[i] > 0 else -shift))
            line = np.floor(offset)
            share = offset - line
            area[i] += curvature * share * (1.0 - share)
            lines[i] = np.int32(line)
            shares[i] = element(share)
    for i in range(count):
        scratch.gain[i] /= area[i]


@compiled
def _aim(corners: Corners, ring: Ring, scratch: Scratch, row: int, count: int) -> None:
    """Of every pixel and corner the first of the four crossings, as an element of the ring, and the weights of all four."""
    here = np.int32((row * ring.stride + ring.margin - ring.left) * 4)
    around = np.int32(ring.rows * ring.stride * 4)
    for corner in range(corners.before.shape[0]):
        plane = np.int32(ALIASED_ROWS * ring.stride * 4 + corners.plane[corner])
        steps = (here, np.int32(corners.step_before[corner]), np.int32(corners.step_after[corner]), plane, around)
        sign = ring.planes.dtype.type(corners.weight[corner])
        before, after = corners.before[corner] * CHUNK_PX, corners.after[corner] * CHUNK_PX
        for i in range(0, count, AIM_PX):
            places = (i, corner * CHUNK_PX, 4 * corner * CHUNK_PX, before, after)
            aim_at_crossings(scratch.target, scratch.weight, scratch.element, scratch.line, scratch.share, places, steps, sign)


@compiled
def _splat_corners(values: np.ndarray, corners: Corners, ring: Ring, scratch: Scratch, y: int, count: int) -> None:
    """Every corner's impulse, on the four crossings of its edges' lattice lines."""
    element = ring.planes.dtype.type
    targets, weights, steps, steps_after = scratch.target, scratch.weight, corners.step_before, corners.step_after
    for i in range(count):
        x = np.uint64(scratch.element[i]) // np.uint64(4)
        gain = element(scratch.gain[i])
        value = (
            element(values[y, x, 0]) * gain,
            element(values[y, x, 1]) * gain,
            element(values[y, x, 2]) * gain,
            element(values[y, x, 3]) * gain,
        )
        for corner in range(corners.before.shape[0]):
            at = np.int64(targets[np.uint64(corner * CHUNK_PX + i)])
            soon = np.int64(targets[np.uint64(corner * CHUNK_PX + i + AHEAD_PX)])
            fetch(ring.planes, soon)
            fetch(ring.planes, soon + steps[corner] + steps_after[corner])
            add_at_crossings(ring.planes, at, steps[corner], steps_after[corner], weights, corner * 4 * CHUNK_PX + i, value)
