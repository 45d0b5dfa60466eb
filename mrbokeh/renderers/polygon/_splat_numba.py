"""Compiled splatting of polygonal differences: pixels of a piece of a row, sorted by how they go into the ring.

Blurred pixels become impulses at the corners of their kernels. Pixels in focus, small kernels and highlights need no sums and are
splatted whole.
"""

import math

import numpy as np

from mrbokeh.optics._aperture_numba import fill_psf
from mrbokeh.renderers.kernels._vectors_numba import (
    AIM_PX,
    BLENDED_CELLS,
    CHUNK_PX,
    add_to_cell,
    add_to_two_cells,
    aim_level,
    aim_steep,
    blend_onto_cells,
    fetch,
    one_by_one,
    scaled,
)
from mrbokeh.renderers.polygon._ring_numba import ALIASED_ROWS, APART_PX, Corners, Exact, Picture, Ring, Scratch, compiled
from mrbokeh.renderers.polygon._survey_numba import TILE_PX

CELLS_OF_LINE = 4
"""Cells of four numbers in single precision that share a line of the cache."""
LINE_PX = 16
"""Numbers of single precision in a line of the cache."""


@compiled
def splat_chunk(
    picture: Picture, corners: Corners, exact: Exact, ring: Ring, scratch: Scratch, y: int, left: int, right: int
) -> tuple[float, float]:
    """Splat pixels left..right of row y; return the largest radius that went through the sums and the largest diameter that did not, 0
    if there was none.
    """
    row = (y + ring.margin) % ring.rows
    halved, most_halved = _halved(picture.halved, y, left, right)
    if halved >= 1.0 and picture.share.shape[0] == 0:
        return 0.0, 0.0
    largest_px = _largest_px(picture, y, left, right)
    _fetch_next_row(picture, y + 1, left, right)
    lit, large = _counted(picture.values[y, left:right].reshape(-1), picture.coc_px[y, left:right], exact.to_px, largest_px)
    if lit == 0:
        return 0.0, 0.0
    if large == right - left and lit > 2 * (right - left) and picture.share.shape[0] == 0:
        largest, whole = math.sqrt(0.25 * largest_px * largest_px + corners.growth), 0.0
        _take_all(picture.coc_px[y, left:right], corners.growth, left, scratch)
        count = right - left if most_halved == 0.0 else _leave_out(picture.halved[y // 2], right - left, scratch)
    else:
        count, largest, whole = _sorted(picture, corners, exact, ring, scratch, y, row, left, right)
    if count:
        splat_corners(picture.values, corners, ring, scratch, y, row, count)
    return largest, whole


@compiled
def _halved(share: np.ndarray, y: int, left: int, right: int) -> tuple[float, float]:
    """Return the least and the greatest share of light that is blurred at half the resolution."""
    if share.shape[0] == 0:
        return 0.0, 0.0
    least, most = np.float32(1.0), np.float32(0.0)
    for column in range(left // 2, (right + 1) // 2):
        least, most = min(least, share[y // 2, column]), max(most, share[y // 2, column])
    return float(least), float(most)


@compiled
def _largest_px(picture: Picture, y: int, left: int, right: int) -> float:
    """Return the largest diameter of all pixels with light in the tiles around."""
    largest = np.float32(0.0)
    for column in range(left // TILE_PX, (right - 1) // TILE_PX + 1):
        largest = max(largest, picture.largest_px[y // TILE_PX, column])
    return float(largest)


@compiled
def _fetch_next_row(picture: Picture, y: int, left: int, right: int) -> None:
    """Prefetch the row below: pieces of rows are too short for the cache to foresee that they go on there."""
    height, width = picture.coc_px.shape
    if y < height:
        values, coc_px = picture.values.reshape(-1), picture.coc_px.reshape(-1)
        for x in range(y * width + left, y * width + right, LINE_PX):
            fetch(coc_px, x)
            for k in range(4):
                fetch(values, 4 * x + k * LINE_PX)


@compiled
def _counted(values: np.ndarray, coc_px: np.ndarray, least_px: float, largest_px: float) -> tuple[int, int]:
    """Return how many values are not 0, and how many diameters lie between both limits."""
    lit, large = np.int32(0), np.int32(0)
    least, most = np.float32(least_px), np.float32(largest_px)
    for i in range(values.shape[0]):
        lit += np.int32(values[i] != 0)
    for i in range(coc_px.shape[0]):
        size = abs(coc_px[i])
        large += np.int32(size >= least) & np.int32(size <= most)
    return int(lit), int(large)


@compiled
def _take_all(coc_px: np.ndarray, growth: float, left: int, scratch: Scratch) -> None:
    """Send all pixels through the sums; those without light add nothing."""
    real = scratch.radius.dtype.type
    quarter, growth = real(0.25), real(growth)
    for i in range(coc_px.shape[0]):
        size = real(coc_px[i])
        radius = np.sqrt(quarter * size * size + growth)
        scratch.radius[i] = radius if size > 0 else -radius
        scratch.gain[i] = real(1.0)
        scratch.element[i] = np.int32(4 * (left + i))


@compiled
def _leave_out(halved: np.ndarray, count: int, scratch: Scratch) -> int:
    """Take away what is blurred at half the resolution, and return how many pixels are left."""
    left = 0
    for i in range(count):
        share = halved[scratch.element[i] >> 3]
        if share < 1:
            scratch.element[left], scratch.radius[left] = scratch.element[i], scratch.radius[i]
            scratch.gain[left] = scratch.gain[i] * (1 - share)
            left += 1
    return left


@compiled
def _sorted(
    picture: Picture, corners: Corners, exact: Exact, ring: Ring, scratch: Scratch, y: int, row: int, left: int, right: int
) -> tuple[int, float, float]:
    """Splat whole the pixels that need no sums; return how many go through the sums, their largest radius, and the largest diameter of
    the rest.
    """
    values, coc_px = picture.values, picture.coc_px
    count, small, largest, whole = 0, 0, 0.0, np.float32(0.0)
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
                keep(values, ring, row, y, x)
            else:
                scratch.small[small], scratch.small_share[small] = np.int32(x), np.float32(1.0 - summed)
                small += 1
        if summed > 0.0 and picture.share.shape[0] > 0 and picture.share[y, x] > 0:
            splat_exactly(values, coc_px[y, x], exact, ring, scratch, row, y, x, summed * picture.share[y, x])
            summed *= 1.0 - picture.share[y, x]
            whole = max(whole, size)
        if picture.halved.shape[0] > 0:
            summed *= 1.0 - picture.halved[y // 2, x // 2]
        if summed > 0.0:
            radius = math.sqrt(0.25 * float(size) * size + corners.growth)
            largest = max(largest, radius)
            scratch.element[count] = np.int32(4 * x)
            scratch.radius[count] = scratch.radius.dtype.type(math.copysign(radius, coc_px[y, x]))
            scratch.gain[count] = scratch.gain.dtype.type(summed)
            count += 1
    splat_small(values, coc_px, exact, ring, scratch, row, y, small)
    return count, largest, float(whole)


@compiled
def splat_corners(values: np.ndarray, corners: Corners, ring: Ring, scratch: Scratch, y: int, row: int, count: int) -> None:
    """Splat the pixels of row y that scratch.element, radius and gain name, into the ring at `row`."""
    _prepare(corners, scratch, count)
    _aim(corners, ring, scratch, row, count)
    _splat(values, corners, ring, scratch, y, count)


@compiled
def _prepare(corners: Corners, scratch: Scratch, count: int) -> None:
    """Set for every pixel and edge the lattice line above it and the share of the next one; then the gain to an exact sum of 1."""
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
    """Set for every pixel and corner the first of the four crossings, as an element of the ring, and the weights of all four."""
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
    """Add every corner's impulse to the four crossings of its edges' lattice lines."""
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
    """Prefetch what the pixel below will need and this one does not: caches do not foresee corners of kernels."""
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


@compiled
def _cell(ring: Ring, row: int, x: int) -> int:
    """Return the place in a plane of column x of a row, which may lie before or after the ring proper."""
    around = ring.rows if row < 0 else (-ring.rows if row >= ring.rows else 0)
    return ((ALIASED_ROWS + row + around) * ring.stride + x - ring.left + ring.margin) * 4


@compiled
def keep(values: np.ndarray, ring: Ring, row: int, y: int, x: int) -> None:
    """Add a pixel in focus."""
    cell = ring.light_plane * ring.plane_elements + _cell(ring, row, x)
    for c in range(4):
        ring.planes[cell + c] += values[y, x, c]


@compiled
def splat_small(values: np.ndarray, coc_px: np.ndarray, exact: Exact, ring: Ring, scratch: Scratch, row: int, y: int, count: int) -> None:
    """Splat the pixels of row y that scratch.small names, each the share of its light in scratch.small_share, by whole kernels."""
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
    """Splat a whole kernel, between the two of the table nearest in diameter."""
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
    """Splat a highlight by the kernel of the aperture itself at its very diameter."""
    radius = max(0, int(math.ceil(abs(diameter_px) * 0.5 * exact.unit_radius - 0.5)))
    size = 2 * radius + 1
    kernel, steps = scratch.kernel[0, : size * size].reshape((size, size)), scratch.kernel[1, : size * size].reshape((size, size))
    fill_psf(kernel, steps, exact.vertices, exact.starts, exact.weights, float(diameter_px))
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
    """Add taps first..end of a row of a kernel, which begins at taps[start], to the cells from `cell` on."""
    even = first + (end - first) // 2 * 2
    for i in range(first, even, 2):
        add_to_two_cells(planes, cell + 4 * i, taps, start + i, value)
    if even < end:
        add_to_cell(planes, cell + 4 * even, taps, start + even, value)
