"""How the buckets of a tile become partitions, and to which of them any sample belongs."""

import math

import numpy as np

from mrbokeh.renderers.layered_reconstruction._filter_numba import extents, slope_distance, spread_px
from mrbokeh.renderers.layered_reconstruction._statistics_numba import rows_of_tile
from mrbokeh.renderers.layered_reconstruction._tile_data import Choice, Light, Partitions
from mrbokeh.system.kernels import njit

WIDEST_PX = 6.0
"""Slopes may differ by the tolerance times the blur, and by that times so many pixels (a standard deviation) where the blur is
wider: the rim of a lamp's disc shows half a pixel. Measured on the scene rain: 38.2 dB with 3, 37.6 with 6, 35.1 without."""

LOOK_BACK = 8
"""Only the last so many partitions are asked to take a bucket: surfaces of several motions lie at one depth."""


@njit(cache=True, nogil=True)
def fits(row: np.ndarray, first: np.ndarray, both: np.ndarray, widest: np.ndarray, light: Light, choice: Choice) -> bool:
    """Whether a bucket may join a partition whose first bucket is `first` and whose widest filter is (u, v) `widest`; sums (SUMS,).

    The common filter may be by the tolerance narrower, along either axis, than that of any bucket in it, and its slopes may
    leave those of its first and its last bucket by that share of their blur. (The paper names the first rule only. By that alone
    a few sharp samples would vanish in many blurred ones behind them, whose filter they hardly change.)
    """
    window, sigma = light.window, choice.sigma_x_px
    one_u, one_v = extents(row, window, sigma, choice.bandwidth)
    both_u, both_v = extents(both, window, sigma, choice.bandwidth)
    least = 1.0 - choice.tolerance
    if both_u < least * max(widest[0], one_u) or both_v < least * max(widest[1], one_v):
        return False
    limit = choice.tolerance * min(1.0, WIDEST_PX / max(one_u, 1e-6))
    return slope_distance(first, both, window, sigma) <= limit and slope_distance(row, both, window, sigma) <= limit


@njit(cache=True, nogil=True)
def merged_rows(rows: np.ndarray, faint: np.ndarray, light: Light, choice: Choice) -> tuple[np.ndarray, np.ndarray]:
    """Sweep the sums (R, SUMS) of buckets front to back. Returns the partition of each (R,) and the sums of partitions (P, SUMS).

    faint: (R,) those that join the partition of the nearest slopes in the end and have no say in its filter.
    """
    merged, own, count = np.zeros_like(rows), np.zeros(len(rows), np.int64), 0
    widest, first = np.zeros((len(rows), 2)), np.zeros(len(rows), np.int64)
    for row in range(len(rows)):
        if faint[row]:
            continue
        joins = count
        if choice.merge:
            for j in range(count - 1, max(-1, count - 1 - LOOK_BACK), -1):
                if fits(rows[row], rows[first[j]], merged[j] + rows[row], widest[j], light, choice):
                    joins = j
                    break
        if joins == count:
            first[count] = row
            count += 1
        own[row] = joins
        merged[joins] += rows[row]
        one_u, one_v = extents(rows[row], light.window, choice.sigma_x_px, choice.bandwidth)
        widest[joins, 0], widest[joins, 1] = max(widest[joins, 0], one_u), max(widest[joins, 1], one_v)
    for row in range(len(rows)):
        if faint[row]:
            own[row] = nearest(rows[row], merged[:count], light, choice)
    return own, merged[:count]


@njit(cache=True, nogil=True)
def nearest(row: np.ndarray, partitions: np.ndarray, light: Light, choice: Choice) -> int:
    """The partition by whose slopes the mean sample of a bucket goes least wrong; the first of several."""
    best, least = 0, np.inf
    for j in range(len(partitions)):
        distance = slope_distance(row, partitions[j], light.window, choice.sigma_x_px)
        if distance < least:
            best, least = j, distance
    return best


@njit(cache=True, nogil=True)
def faint_rows(rows: np.ndarray, held: np.ndarray, light: Light, choice: Choice) -> np.ndarray:
    """Which buckets (R,) can hardly be seen: spread over the area of their filter, their samples hide no more than the share
    choice.faint of what is there, nor are they brighter than that share of the mean of the tile and the blocks around it.

    The area is that of an even disc of the same second moments. Where all are faint none is.
    """
    faint = np.zeros(len(rows), np.bool_)
    if choice.faint > 0.0:
        typical = (held[:, 2].sum() / held[:, 0].sum()) ** 2
        for row in range(len(rows)):
            sigma_u, sigma_v = spread_px(rows[row], light.window, choice.sigma_x_px)
            most = choice.faint * light.per_pixel * 4.0 * math.pi * sigma_u * sigma_v
            faint[row] = held[row, 0] <= most and held[row, 1] <= most * typical
    return faint if not faint.all() else np.zeros(len(rows), np.bool_)


@njit(cache=True, nogil=True)
def partitions_of_tile(tile: int, light: Light, choice: Choice, place: np.ndarray) -> tuple[Partitions, np.ndarray, int]:
    """Also the buckets whose place (B,) is to be -1 again for the next tile, as it must come, and how many buckets are populated."""
    buckets, rows, held = rows_of_tile(tile, light, choice, place)
    faint = faint_rows(rows, held, light, choice)
    own, merged = merged_rows(rows, faint, light, choice)
    first = np.full(len(merged), light.depths, np.int64)
    for row in range(len(buckets)):
        place[buckets[row]] = 2 * own[row]
        if not faint[row]:
            first[own[row]] = min(first[own[row]], buckets[row] // light.cells)
    gaps = np.full(light.depths, -1, np.int64)
    for j in range(len(merged)):
        gaps[first[j] :] = 2 * j + 1
    return Partitions(merged, first, place, gaps), widened(buckets, place, light), len(buckets)


@njit(cache=True, nogil=True)
def widened(buckets: np.ndarray, place: np.ndarray, light: Light) -> np.ndarray:
    """Free neighbours of each bucket, in depth and in motion, go with it: a surface goes on beyond the tile.

    Returns all buckets that then have a place.
    """
    known, cells_y = list(buckets), light.cells // light.cells_x
    for bucket in buckets:
        depth, cell = bucket // light.cells, bucket % light.cells
        at_x, at_y = cell % light.cells_x, cell // light.cells_x
        for off_depth in range(-1, 2):
            for off_y in range(-1, 2):
                for off_x in range(-1, 2):
                    if off_depth != 0 and (off_x != 0 or off_y != 0):
                        continue
                    d, x, y = depth + off_depth, at_x + off_x, at_y + off_y
                    if 0 <= d < light.depths and 0 <= x < light.cells_x and 0 <= y < cells_y:
                        beside = d * light.cells + y * light.cells_x + x
                        if place[beside] < 0:
                            place[beside] = place[bucket]
                            known.append(beside)
    return np.array(known)
