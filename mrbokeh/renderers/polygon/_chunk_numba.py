"""A piece of a row: its pixels sorted by how they are splatted."""

import math

import numpy as np

from mrbokeh.renderers.kernels._vectors_numba import fetch
from mrbokeh.renderers.polygon._ring_numba import Corners, Exact, Picture, Ring, Scratch, compiled
from mrbokeh.renderers.polygon._splat_numba import splat_corners
from mrbokeh.renderers.polygon._survey_numba import TILE_PX
from mrbokeh.renderers.polygon._whole_numba import keep, splat_exactly, splat_small

LINE_PX = 16
"""Numbers of single precision in a line of the cache."""


@compiled
def splat_chunk(
    picture: Picture, corners: Corners, exact: Exact, ring: Ring, scratch: Scratch, y: int, left: int, right: int
) -> tuple[float, float]:
    """Splat pixels left..right of row y; the largest radius that went through the sums and the largest diameter that did not,
    both 0 if there was none."""
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
    """The least and the greatest share of light that is spread at half the resolution."""
    if share.shape[0] == 0:
        return 0.0, 0.0
    least, most = np.float32(1.0), np.float32(0.0)
    for column in range(left // 2, (right + 1) // 2):
        least, most = min(least, share[y // 2, column]), max(most, share[y // 2, column])
    return float(least), float(most)


@compiled
def _largest_px(picture: Picture, y: int, left: int, right: int) -> float:
    """Of all pixels with light in the tiles around."""
    largest = np.float32(0.0)
    for column in range(left // TILE_PX, (right - 1) // TILE_PX + 1):
        largest = max(largest, picture.largest_px[y // TILE_PX, column])
    return float(largest)


@compiled
def _fetch_next_row(picture: Picture, y: int, left: int, right: int) -> None:
    """Pieces of rows are too short for the cache to foresee that they go on below."""
    height, width = picture.coc_px.shape
    if y < height:
        values, coc_px = picture.values.reshape(-1), picture.coc_px.reshape(-1)
        for x in range(y * width + left, y * width + right, LINE_PX):
            fetch(coc_px, x)
            for k in range(4):
                fetch(values, 4 * x + k * LINE_PX)


@compiled
def _counted(values: np.ndarray, coc_px: np.ndarray, least_px: float, largest_px: float) -> tuple[int, int]:
    """How many values are not 0, and how many diameters lie between both."""
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
    """All pixels go through the sums; those without light add nothing."""
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
    """Take away what is spread at half the resolution; how many pixels are left."""
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
    """Splat whole what need not go through the sums; how many pixels do, their largest radius, the largest diameter of the rest."""
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
