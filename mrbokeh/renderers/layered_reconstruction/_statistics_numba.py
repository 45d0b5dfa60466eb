"""Sums over the samples of each tile and depth bucket, from all samples or a sparse stratified choice, and their merging."""

import numpy as np
from numba import njit

from mrbokeh.renderers.layered_reconstruction._filter_numba import SUMS, extents, slope_distance

SLOPES = 2.0
"""Slopes may differ by so many times the share by which filters may shrink. With 2, 4.0 partitions of a tile become 2.7 in the fence scene
of the benchmark and 7.4 become 3.4 on its slanted plane, for 0.1 and 0.8 to 1.0 dB; with 1 fewer merge, for nearly nothing."""


@njit(cache=True, nogil=True)
def xorshift(state: int) -> int:
    """The next number of a 32 bit xor-shift generator with the triple (13, 17, 5) of Marsaglia 2003; the state is never 0."""
    state ^= (state << 13) & 0xFFFFFFFF
    state ^= state >> 17
    state ^= (state << 5) & 0xFFFFFFFF
    return state


@njit(cache=True, nogil=True)
def seeded(seed: int, tile: int) -> int:
    """A state for a tile, far from that of its neighbours."""
    state = (seed * 2654435761 + tile * 2246822519 + 374761393) & 0xFFFFFFFF
    state = state if state else 1
    for _ in range(4):
        state = xorshift(state)
    return state


@njit(cache=True, nogil=True)
def bucket_sums(sums: np.ndarray, first: int, end: int, every: int, state: int, bucket: np.ndarray, slopes: np.ndarray) -> int:
    """Add one sample out of each `every` from first to end to sums (buckets, SUMS); returns how many.

    slopes: (N, 3) half the signed circle of confusion, motion x and y.
    """
    taken = 0
    for begin in range(first, end, every):
        i = begin
        if every > 1:
            state = xorshift(state)
            i = begin + state % min(every, end - begin)
        row = sums[bucket[i]]
        r, m_x, m_y = np.float64(slopes[i, 0]), np.float64(slopes[i, 1]), np.float64(slopes[i, 2])
        row[0] += 1.0
        row[1] += r
        row[2] += r * r
        row[3] += m_x
        row[4] += m_y
        row[5] += m_x * m_x
        row[6] += m_x * m_y
        row[7] += m_y * m_y
        taken += 1
    return taken


@njit(cache=True, nogil=True)
def add_missed(sums: np.ndarray, first: int, end: int, every: int, bucket: np.ndarray, slopes: np.ndarray) -> None:
    """Sum buckets that hold samples, none of which was chosen, over all of them: a lamp must not vanish by chance."""
    missed = np.zeros(len(sums), np.bool_)
    some = False
    for i in range(first, end):
        if sums[bucket[i], 0] == 0.0:
            missed[bucket[i]] = some = True
    if some:
        for i in range(first, end):
            if missed[bucket[i]]:
                bucket_sums(sums, i, i + 1, 1, 1, bucket, slopes)
        for index in range(len(sums)):
            if missed[index]:
                sums[index] /= every


@njit(cache=True, nogil=True)
def partitions_of(
    sums: np.ndarray, merged: np.ndarray, spans: np.ndarray, window: np.ndarray, sigma_x_px: float, bandwidth: float, limit: tuple
) -> tuple[int, int]:
    """Sweep the populated buckets front to back and fill merged (P, SUMS) and spans (P, 2: first and last bucket).

    limit: whether to merge, and the tolerance: the common filter may be by that share narrower, along either axis, than that
    of any bucket in it, and its slopes may differ from those of its first and last by SLOPES times that share of their blur.
    (The paper names the first only. By that alone a few sharp samples would vanish in many blurred ones behind them, whose
    filter they hardly change.)
    Returns the number of populated buckets and of partitions.
    """
    merge, tolerance = limit
    populated, count = 0, 0
    widest_u = widest_v = 0.0
    for index in range(len(sums)):
        if sums[index, 0] == 0.0:
            continue
        populated += 1
        joins, one_u, one_v = False, 0.0, 0.0
        if merge:
            one_u, one_v = extents(sums[index], window, sigma_x_px, bandwidth)
            if count > 0:
                both = merged[count - 1] + sums[index]
                both_u, both_v = extents(both, window, sigma_x_px, bandwidth)
                joins = both_u >= (1.0 - tolerance) * max(widest_u, one_u) and both_v >= (1.0 - tolerance) * max(widest_v, one_v)
                joins = joins and slope_distance(sums[spans[count - 1, 0]], both, window, sigma_x_px) <= SLOPES * tolerance
                joins = joins and slope_distance(sums[index], both, window, sigma_x_px) <= SLOPES * tolerance
        if joins:
            merged[count - 1] += sums[index]
            spans[count - 1, 1] = index
            widest_u, widest_v = max(widest_u, one_u), max(widest_v, one_v)
        else:
            merged[count] = sums[index]
            spans[count, 0], spans[count, 1] = index, index
            widest_u, widest_v = one_u, one_v
            count += 1
    return populated, count


@njit(cache=True, nogil=True)
def widen(spans: np.ndarray, count: int) -> None:
    """Each partition takes the empty bucket before and the one behind it, where they are free: a surface goes on beyond the tile."""
    for j in range(count):
        before = spans[j - 1, 1] if j > 0 else -2
        if spans[j, 0] - before > 1:
            spans[j, 0] -= 1
        behind = spans[j + 1, 0] if j + 1 < count else spans[j, 1] + 2
        if behind - spans[j, 1] > 1:
            spans[j, 1] += 1


@njit(cache=True, nogil=True)
def survey_tiles(
    tiles: np.ndarray,
    starts: np.ndarray,
    bucket: np.ndarray,
    slopes: np.ndarray,
    every: int,
    seed: int,
    window: np.ndarray,
    sigma_x_px: float,
    bandwidth: float,
    limit: tuple,
    partitions: np.ndarray,
    spans: np.ndarray,
    counts: np.ndarray,
) -> None:
    """Partitions (T, P, SUMS), spans (T, P, 2) and counts (T, 2: before and after merging) of the tiles named."""
    sums = np.zeros((partitions.shape[1], SUMS))
    for tile in tiles:
        sums[:] = 0.0
        bucket_sums(sums, starts[tile], starts[tile + 1], every, seeded(seed, tile), bucket, slopes)
        if every > 1:
            add_missed(sums, starts[tile], starts[tile + 1], every, bucket, slopes)
        before, after = partitions_of(sums, partitions[tile], spans[tile], window, sigma_x_px, bandwidth, limit)
        counts[tile, 0], counts[tile, 1] = before, after
        widen(spans[tile], after)
