"""Sums over the samples of a tile for each bucket it holds, from all samples or a sparse stratified choice."""

import math
from typing import NamedTuple

import numpy as np

from mrbokeh.renderers.layered_reconstruction._filter_numba import SUMS
from mrbokeh.renderers.layered_reconstruction._samples_numba import morton
from mrbokeh.renderers.layered_reconstruction._tile_data import BLOCKS, BLOCKS_ACROSS, Choice, Light
from mrbokeh.system.kernels import njit


class Rows(NamedTuple):
    """What was found so far: buckets (R,) and sums (R, SUMS), used[0] of which are in use; place (B,) is the row of a bucket or -1."""

    buckets: np.ndarray
    sums: np.ndarray
    used: np.ndarray
    place: np.ndarray


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
def rows_of_tile(tile: int, light: Light, choice: Choice, place: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Buckets (R,), in rising order, and sums (R, SUMS) of all that the tile and the blocks around it hold; of the same samples, all of
    them, the number, the light and its root (R, 3).

    place: (B,) of -1; afterwards not, for these buckets. What none of the chosen samples saw is summed over all samples, and what
    only the blocks around hold over those: a lamp must not vanish by chance, nor where its light leaves a tile's corner.
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
    """slope: half the signed circle of confusion, motion x and y."""
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
    """The blocks of other tiles that touch this one."""
    rows, row, column = (len(light.starts) - 1) // BLOCKS // light.columns, tile // light.columns, tile % light.columns
    blocks = []
    for y in range(row * BLOCKS_ACROSS - 1, (row + 1) * BLOCKS_ACROSS + 1):
        for x in range(column * BLOCKS_ACROSS - 1, (column + 1) * BLOCKS_ACROSS + 1):
            at_row, at_column = y // BLOCKS_ACROSS, x // BLOCKS_ACROSS
            inside = 0 <= at_row < rows and 0 <= at_column < light.columns
            if inside and not (at_row == row and at_column == column):
                blocks.append((at_row * light.columns + at_column) * BLOCKS + morton(x % BLOCKS_ACROSS, y % BLOCKS_ACROSS))
    return blocks
