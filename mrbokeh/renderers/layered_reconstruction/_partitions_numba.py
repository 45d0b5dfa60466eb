"""Compiled partitions of a tile: sums over the samples of each bucket, and how buckets with like filters become partitions.

Sums are over all samples or a sparse stratified choice. Every bucket, also one that the tile does not hold, belongs to a partition or
lies between two.
"""

import math
from typing import NamedTuple

import numpy as np

from mrbokeh.renderers.layered_reconstruction._filter_numba import SUMS, blur_px, extents, morton, slope_distance
from mrbokeh.renderers.layered_reconstruction._tile_data import BLOCKS, BLOCKS_ACROSS, Choice, Light, Partitions
from mrbokeh.system.compiled import njit

WIDEST_PX = 6.0
"""Slopes may differ by the tolerance times the blur, and by that times so many pixels (a standard deviation) where the blur is
wider: the rim of a lamp's disc shows half a pixel. Measured on the scene rain: 38.2 dB with 3, 37.6 with 6, 35.1 without."""
LOOK_BACK = 8
"""Only the last so many partitions are asked to take a bucket: surfaces of several motions lie at one depth."""


@njit(cache=True, nogil=True)
def fits(row: np.ndarray, first: np.ndarray, both: np.ndarray, widest: np.ndarray, light: Light, choice: Choice) -> bool:
    """Return whether a bucket may join a partition whose first bucket is `first` and whose widest filter is (u, v) `widest`; sums (SUMS,).

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
    """Return the partition by whose slopes the mean sample of a bucket goes least wrong; the first of several."""
    best, least = 0, np.inf
    for j in range(len(partitions)):
        distance = slope_distance(row, partitions[j], light.window, choice.sigma_x_px)
        if distance < least:
            best, least = j, distance
    return best


@njit(cache=True, nogil=True)
def faint_rows(rows: np.ndarray, held: np.ndarray, light: Light, choice: Choice) -> np.ndarray:
    """Return which buckets (R,) can hardly be seen: spread over the area of their filter, their samples hide no more than the share
    choice.faint of what is there, nor are they brighter than that share of the mean of the tile and the blocks around it.

    The area is that of an even disc of the same second moments. Where all are faint none is.
    """
    faint = np.zeros(len(rows), np.bool_)
    if choice.faint > 0.0:
        typical = (held[:, 2].sum() / held[:, 0].sum()) ** 2
        for row in range(len(rows)):
            sigma_u, sigma_v = blur_px(rows[row], light.window, choice.sigma_x_px)
            most = choice.faint * light.per_pixel * 4.0 * math.pi * sigma_u * sigma_v
            faint[row] = held[row, 0] <= most and held[row, 1] <= most * typical
    return faint if not faint.all() else np.zeros(len(rows), np.bool_)


@njit(cache=True, nogil=True)
def partitions_of_tile(tile: int, light: Light, choice: Choice, place: np.ndarray) -> tuple[Partitions, np.ndarray, int]:
    """Return the partitions, the buckets whose place (B,) must be set to -1 again for the next tile, and how many buckets are
    populated.
    """
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
    """Give free neighbours of each bucket, in depth and in motion, its place: a surface goes on beyond the tile.

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


class Rows(NamedTuple):
    """Rows found so far: buckets (R,) and sums (R, SUMS), used[0] of which are in use; place (B,) is the row of a bucket or -1."""

    buckets: np.ndarray
    sums: np.ndarray
    used: np.ndarray
    place: np.ndarray


@njit(cache=True, nogil=True)
def xorshift(state: int) -> int:
    """Return the next number of a 32 bit xor-shift generator with the triple (13, 17, 5) of Marsaglia 2003; the state is never 0."""
    state ^= (state << 13) & 0xFFFFFFFF
    state ^= state >> 17
    state ^= (state << 5) & 0xFFFFFFFF
    return state


@njit(cache=True, nogil=True)
def seeded(seed: int, tile: int) -> int:
    """Return a state for a tile, far from that of its neighbours."""
    state = (seed * 2654435761 + tile * 2246822519 + 374761393) & 0xFFFFFFFF
    state = state if state else 1
    for _ in range(4):
        state = xorshift(state)
    return state


@njit(cache=True, nogil=True)
def rows_of_tile(tile: int, light: Light, choice: Choice, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return buckets (R,), in rising order, and sums (R, SUMS) of all that the tile and the blocks around it hold; of the same samples,
    all of them, the number, the light and its root (R, 3).

    place: (B,) of -1; afterwards not, for these buckets. Buckets that none of the chosen samples is in are summed over all samples, and
    buckets that only the blocks around hold over those: a lamp must not vanish by chance, nor where its light leaves a tile's corner.
    """
    first, end = light.starts[tile * BLOCKS], light.starts[(tile + 1) * BLOCKS]
    beside = blocks_around(tile, light)
    most = end - first
    for block in beside:
        most += light.starts[block + 1] - light.starts[block]
    rows = Rows(np.empty(most, np.int64), np.empty((most, SUMS)), np.zeros(1, np.int64), place)
    add_chosen(rows, first, end, choice.every, seeded(choice.seed, tile), light)
    known = rows.used[0]
    if choice.every > 1:
        add_unknown(rows, known, first, end, light)
    own = rows.used[0]
    for block in beside:
        add_unknown(rows, own, light.starts[block], light.starts[block + 1], light)
    count = rows.used[0]
    rows.sums[known:count] /= choice.every
    order = np.argsort(rows.buckets[:count])
    held = np.zeros((count, 3))
    if choice.faint > 0.0:
        add_light(held, rows, first, end, light)
        for block in beside:
            add_light(held, rows, light.starts[block], light.starts[block + 1], light)
    return rows.buckets[:count][order], rows.sums[:count][order], held[order]


@njit(cache=True, nogil=True)
def add_chosen(rows: Rows, first: int, end: int, every: int, state: int, light: Light) -> None:
    """Add one sample, by chance, out of each `every` from first to end."""
    for begin in range(first, end, every):
        i = begin
        if every > 1:
            state = xorshift(state)
            i = begin + state % min(every, end - begin)
        add_sample(rows, light.bucket[i], light.slopes[i])


@njit(cache=True, nogil=True)
def add_unknown(rows: Rows, known: int, first: int, end: int, light: Light) -> None:
    """Add all samples from first to end whose bucket is not among the first `known` rows."""
    for i in range(first, end):
        row = rows.place[light.bucket[i]]
        if row < 0 or row >= known:
            add_sample(rows, light.bucket[i], light.slopes[i])


@njit(cache=True, nogil=True)
def add_sample(rows: Rows, bucket: int, slope: np.ndarray) -> None:
    """Add a sample to its bucket's row. slope: half the signed circle of confusion, motion x and y."""
    if rows.place[bucket] < 0:
        new = rows.used[0]
        rows.place[bucket], rows.buckets[new] = new, bucket
        rows.sums[new] = 0.0
        rows.used[0] = new + 1
    row = rows.sums[rows.place[bucket]]
    r, m_x, m_y = np.float64(slope[0]), np.float64(slope[1]), np.float64(slope[2])
    row[0] += 1.0
    row[1] += r
    row[2] += r * r
    row[3] += m_x
    row[4] += m_y
    row[5] += m_x * m_x
    row[6] += m_x * m_y
    row[7] += m_y * m_y


@njit(cache=True, nogil=True)
def add_light(held: np.ndarray, rows: Rows, first: int, end: int, light: Light) -> None:
    """Count all samples from first to end for their buckets, and add their light, the largest of their channels."""
    for i in range(first, end):
        most = np.float32(0.0)
        for c in range(light.values.shape[1]):
            most = max(most, abs(light.values[i, c]))
        row = rows.place[light.bucket[i]]
        held[row, 0] += 1.0
        held[row, 1] += most
        held[row, 2] += math.sqrt(most)


@njit(cache=True, nogil=True)
def blocks_around(tile: int, light: Light) -> list[int]:
    """Return the blocks of other tiles that touch this one."""
    rows, row, column = (len(light.starts) - 1) // BLOCKS // light.columns, tile // light.columns, tile % light.columns
    blocks = []
    for y in range(row * BLOCKS_ACROSS - 1, (row + 1) * BLOCKS_ACROSS + 1):
        for x in range(column * BLOCKS_ACROSS - 1, (column + 1) * BLOCKS_ACROSS + 1):
            at_row, at_column = y // BLOCKS_ACROSS, x // BLOCKS_ACROSS
            inside = 0 <= at_row < rows and 0 <= at_column < light.columns
            if inside and not (at_row == row and at_column == column):
                blocks.append((at_row * light.columns + at_column) * BLOCKS + morton(x % BLOCKS_ACROSS, y % BLOCKS_ACROSS))
    return blocks
