"""Halving the resolution of what is far out of focus, and doubling it again.

Cell (j, i) of the half picture covers the block of pixels (2 j - 2, 2 i - 2) to (2 j - 1, 2 i - 1): there is one more cell on every
side. A pixel gives 3/4 of its light to the cell that covers it and 1/4 to the next nearest, in each direction, which keeps the
centre of its light where it is; pixels take from cells by the same shares.
"""

import numpy as np

from mrbokeh.renderers.polygon._ring_numba import compiled

NEAR, FAR = np.float32(0.75), np.float32(0.25)
ONE, SIX = np.float32(1.0), np.float32(6.0)
"""Shares, in eighths, of the light of a block next to a cell's own, and of the cell's own block, that the cell gets."""


@compiled
def halve_rows(
    values: np.ndarray, highlights: np.ndarray, share: np.ndarray, rows: tuple[int, int], line: np.ndarray, half: np.ndarray
) -> None:
    """Some rows of cells, half (rows, 4 cells): the light that is halved. values (H, 4 W); line (4 W + 24) is scratch space."""
    for row in range(rows[0], rows[1]):
        line[:] = 0.0
        for k in range(4):
            y = 2 * row - 3 + k
            if 0 <= y < values.shape[0]:
                weight = NEAR if k == 1 or k == 2 else FAR
                _add_row_taken(line[12:], values[y], share[y // 2], weight)
                if highlights.shape[0] > 0:
                    _give_back(line[12:], values[y], highlights[y], weight, share[y // 2])
        for i in range(half.shape[1] // 4):
            for c in range(4):
                at = 8 * i + c
                half[row, 4 * i + c] = FAR * (line[at] + line[at + 12]) + NEAR * (line[at + 4] + line[at + 8])


@compiled
def _add_row_taken(line: np.ndarray, values: np.ndarray, share: np.ndarray, weight: float) -> None:
    """Blocks of one share together."""
    start = 0
    for block in range(1, share.shape[0] + 1):
        if block == share.shape[0] or share[block] != share[start]:
            if share[start] > 0:
                _add_taken(line[8 * start :], values[8 * start : 8 * block], weight * share[start])
            start = block


@compiled
def _add_taken(line: np.ndarray, values: np.ndarray, weight: float) -> None:
    for i in range(values.shape[0]):
        line[i] += weight * values[i]


@compiled
def _give_back(line: np.ndarray, values: np.ndarray, highlights: np.ndarray, weight: float, of_blocks: np.ndarray) -> None:
    """The light of highlights is spread elsewhere."""
    for x in range(highlights.shape[0]):
        if highlights[x] > 0:
            for c in range(4):
                line[4 * x + c] -= weight * of_blocks[x // 2] * highlights[x] * values[4 * x + c]


@compiled
def halve_diameters(share: np.ndarray, weighted_px: np.ndarray, rows: tuple[int, int], work: np.ndarray, half_coc_px: np.ndarray) -> None:
    """Some rows of cells: the mean diameter, in cells, of the light they get, as if it were even within a block.

    work (2, cells + 2) is scratch space.
    """
    half = np.float32(0.5)
    for row in range(rows[0], rows[1]):
        work[:] = 0.0
        for y in range(max(row - 2, 0), min(row + 1, share.shape[0])):
            weight = SIX if y == row - 1 else ONE
            for x in range(share.shape[1]):
                work[0, x + 2] += weight * share[y, x]
                work[1, x + 2] += weight * weighted_px[y, x]
        weights, summed = work[0], work[1]
        for i in range(half_coc_px.shape[1]):
            weight = weights[i] + SIX * weights[i + 1] + weights[i + 2]
            diameter = summed[i] + SIX * summed[i + 1] + summed[i + 2]
            half_coc_px[row, i] = half * diameter / (weight if weight > 0 else ONE)


@compiled
def add_doubled_row(half: np.ndarray, y: int, line: np.ndarray, out: np.ndarray) -> None:
    """Add row y of the picture of which half (rows, 4 cells) is the half one: a quarter of a cell's light falls on each pixel.

    line (4 cells) is scratch space.
    """
    near, next_ = y // 2 + 1, (y // 2 if y % 2 == 0 else y // 2 + 2)
    quarter = np.float32(0.25)
    for i in range(line.shape[0]):
        line[i] = quarter * (NEAR * half[near, i] + FAR * half[next_, i])
    for pair in range(out.shape[0] // 8):
        for c in range(4):
            before, here, after = line[4 * pair + c], line[4 * pair + 4 + c], line[4 * pair + 8 + c]
            out[8 * pair + c] += NEAR * here + FAR * before
            out[8 * pair + 4 + c] += NEAR * here + FAR * after
    if out.shape[0] % 8:
        last = out.shape[0] // 8
        for c in range(4):
            out[8 * last + c] += NEAR * line[4 * last + 4 + c] + FAR * line[4 * last + c]
