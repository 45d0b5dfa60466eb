"""Reprojection of the samples around a tile along the slopes of one partition (Eq. 1)."""

import math

import numpy as np

from mrbokeh.renderers.layered_reconstruction._samples_numba import morton
from mrbokeh.renderers.layered_reconstruction._tile_data import BLOCKS, BLOCKS_ACROSS, Light, Partitions, Slope
from mrbokeh.system.kernels import njit

BESIDE_DEPTHS = 16
"""Up to so many depth buckets in front of a partition may belong to the same slanted surface."""

_SHARP_PX = 0.5


@njit(cache=True, nogil=True)
def reproject(
    planes: np.ndarray, left: int, top: int, slope: Slope, j: int, partitions: Partitions, light: Light, shared_out: bool
) -> None:
    """Add to planes (h, w, C + 3), whose top left pixel is (left, top), colour, opacity, weight and count of the partition j.

    A sample of the partition adds its values and an opacity, a weight and a count of 1. One behind adds a weight and a
    count: it was seen through this place. One just in front adds a count alone, one far in front nothing.
    """
    height, width, _ = planes.shape
    reach_x = abs(slope.a) * light.pupil_radius + 0.5 * abs(slope.b_x)
    reach_y = abs(slope.a) * light.pupil_radius + 0.5 * abs(slope.b_y)
    sharp = not shared_out or (reach_x < _SHARP_PX and reach_y < _SHARP_PX)
    side_px = light.tile_px // BLOCKS_ACROSS
    rows = (len(light.starts) - 1) // BLOCKS // light.columns
    first_x, last_x = block_range(left, width, reach_x, side_px, light.columns * BLOCKS_ACROSS)
    first_y, last_y = block_range(top, height, reach_y, side_px, rows * BLOCKS_ACROSS)
    for y in range(first_y, last_y + 1):
        for x in range(first_x, last_x + 1):
            tile = (y // BLOCKS_ACROSS) * light.columns + x // BLOCKS_ACROSS
            block = tile * BLOCKS + morton(x % BLOCKS_ACROSS, y % BLOCKS_ACROSS)
            add_block(planes, left, top, light.starts[block], light.starts[block + 1], sharp, slope, j, partitions, light)


@njit(cache=True, nogil=True)
def block_range(from_px: int, size_px: int, reach_px: float, side_px: int, count: int) -> tuple[int, int]:
    """The first and last block whose samples may land on the pixels from from_px on."""
    first, last = int(math.floor((from_px - reach_px) / side_px)), int(math.floor((from_px + size_px + reach_px) / side_px))
    return max(0, first), min(count - 1, last)


@njit(cache=True, nogil=True)
def add_block(
    planes: np.ndarray, left: int, top: int, first: int, end: int, sharp: bool, slope: Slope, j: int, partitions: Partitions, light: Light
) -> None:
    """The samples from first to end. sharp: each counts for the pixel it is in; else it is shared out among the four nearest."""
    height, width, channels = planes.shape
    flat, across, step_x, zero = planes.reshape(-1), np.uint64(width * channels), np.uint64(channels), np.uint64(0)
    to_opacity, to_weight, to_count = np.uint64(channels - 3), np.uint64(channels - 2), np.uint64(channels - 1)
    a, b_x, b_y = np.float32(slope.a), np.float32(slope.b_x), np.float32(slope.b_y)
    off_x, off_y = np.float32(left), np.float32(top)
    if not sharp:
        off_x, off_y, width, height = off_x + np.float32(0.5), off_y + np.float32(0.5), width - 1, height - 1
    own, before = 2 * j, (partitions.first[j] - BESIDE_DEPTHS) * light.cells
    geometry, buckets, values = light.geometry[first:end], light.bucket[first:end], light.values[first:end]
    for i in range(end - first):
        if buckets[i] < before:
            continue
        x = geometry[i, 0] - a * geometry[i, 2] - b_x * geometry[i, 4] - off_x
        y = geometry[i, 1] - a * geometry[i, 3] - b_y * geometry[i, 4] - off_y
        if not (np.float32(0.0) <= x < width and np.float32(0.0) <= y < height):
            continue
        bucket = np.uint64(buckets[i])
        at = partitions.place[bucket]
        if at < 0:
            at = partitions.gaps[bucket // np.uint64(light.cells)]
        column, row = int(x), int(y)
        # Without signs the compiler has no negative indices to look for, which would take it as long as all the rest.
        place = np.uint64(row) * across + np.uint64(column * channels)
        right, below, taps = np.float32(0.0), np.float32(0.0), 1
        if not sharp:
            right, below, taps = x - np.float32(column), y - np.float32(row), 4
        one, other = np.float32(1.0) - right, np.float32(1.0) - below
        if at < own:
            for tap in range(taps):
                share = (right if tap & 1 else one) * (below if tap >> 1 else other)
                flat[place + (step_x if tap & 1 else zero) + (across if tap >> 1 else zero) + to_count] += share
        else:
            for tap in range(taps):
                share = (right if tap & 1 else one) * (below if tap >> 1 else other)
                to = place + (step_x if tap & 1 else zero) + (across if tap >> 1 else zero)
                flat[to + to_count] += share
                flat[to + to_weight] += share
                if at == own:
                    for c in range(channels - 3):
                        flat[to + np.uint64(c)] += share * values[i, c]
                    flat[to + to_opacity] += share


@njit(cache=True, nogil=True)
def evened_out(planes: np.ndarray, enough: float) -> np.ndarray:
    """Planes (h, w, C + 2) without the count, in which no place weighs more than `enough` samples do, its colour and opacity in
    proportion.

    Samples fall on places in uneven numbers by chance. Left so, that chance is noise in every mean over places.
    """
    height, width, channels = planes.shape
    channels -= 1
    even = np.empty((height, width, channels), np.float32)
    for y in range(height):
        for x in range(width):
            count = planes[y, x, channels]
            share = np.float32(enough) / count if count > enough else np.float32(1.0)
            for c in range(channels):
                even[y, x, c] = share * planes[y, x, c]
    return even
