"""Compiled loops of Laplacian spreadlets: the kernel that every pixel takes, the tridiagonal sweeps of integration, and how they are made.

Spreadlets are made by darts, Lloyd's relaxation, sums over Voronoi cells and annealing. Pixels of a Laplacian come as xy (M, 2) whole
pixels with charges (M, C) and importance (M,); points as (N, 2).
"""

import math
from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit

NONE = -1
_STRETCH_PX = 32
NEAR = 4  # levels that are found by steps


class Limits(NamedTuple):
    """Sizes of blur at which kernels change. borders_px: where each level of those beyond dense_up_to_px begins.

    The last 2 NEAR of the borders are infinitely large.
    """

    sharp_up_to_px: float
    dense_up_to_px: float
    dense_per_px: float
    levels_per_octave: float
    borders_px: np.ndarray
    blocks: int


@njit(cache=True, nogil=True)
def choose_cells(codes: np.ndarray, out: np.ndarray, values: np.ndarray, coc_px: np.ndarray, bright: np.ndarray, limits: Limits) -> bool:
    """Set the code of every pixel's kernel; sharp pixels are copied to out and have none. Returns False if a circle of confusion is not
    finite.

    A code is a level + blocks * kind + 3 * blocks * (in front of the focus); kinds: 0 dense, 1 sparse, 2 whole Laplacian.
    """
    sharp_up_to_px, dense_up_to_px, dense_per_px, levels_per_octave, borders_px, blocks = limits
    height, width, channels = values.shape
    finite = True
    level = 0  # neighbours often have the same: so much logarithms would take longer than all the rest
    for y in range(height):
        for x in range(width):
            lit = False
            for c in range(channels):
                lit = lit or values[y, x, c] != 0
            size = abs(coc_px[y, x]) if lit else np.float32(0)
            codes[y, x] = NONE
            if not np.isfinite(size):
                finite = False
            elif size <= sharp_up_to_px:
                for c in range(channels):
                    out[y, x, c] = values[y, x, c]
            else:
                if size <= dense_up_to_px:
                    code = int(np.rint(size * dense_per_px))
                else:
                    if size < borders_px[max(0, level - NEAR)] or size > borders_px[level + NEAR]:
                        level = min(int(np.log2(size / borders_px[0]) * levels_per_octave), len(borders_px) - 2 * NEAR)
                    while size < borders_px[level]:
                        level -= 1
                    while size >= borders_px[level + 1]:
                        level += 1
                    code = level + (2 * blocks if bright[y, x] else blocks)
                codes[y, x] = code + 3 * blocks if coc_px[y, x] < 0 else code
    return finite


@njit(cache=True, nogil=True)
def mark_used(used: np.ndarray, codes: np.ndarray) -> None:
    """Set used[code] for every code of a picture (H, W) but NONE."""
    for code in codes.flat:
        if code != NONE:
            used[code] = True


@njit(cache=True, nogil=True)
def _mirrored(place: int, length: int) -> int:
    """Return the place inside that a place beyond the border shows, as in a mirror that stands on the last pixel."""
    while (place < 0 or place >= length) and length > 1:
        place = -place if place < 0 else 2 * (length - 1) - place
    return place if length > 1 else 0


@njit(cache=True, nogil=True, error_model="numpy")
def find_outshining(found: np.ndarray, values: np.ndarray, radius_px: int, times: float, first: int, end: int) -> None:
    """Mark the pixels (H, W) of rows first:end that have a channel of values (H, W, C) more than so many times the mean around them.

    Around: a square of 2 radius_px + 1 pixels, beyond the border as in a mirror; its sum goes along with columns and rows.
    """
    height, width, channels = values.shape
    margin, rows = radius_px * channels, values.reshape(height, -1)
    columns, box = np.zeros(rows.shape[1] + 2 * margin), np.empty(rows.shape[1])
    inner = columns[margin : margin + rows.shape[1]]
    limit = times / (2 * radius_px + 1) ** 2
    for y in range(first - radius_px, first + radius_px):
        inner += np.abs(rows[_mirrored(y, height)])
    for y in range(first, end):
        coming, going = rows[_mirrored(y + radius_px, height)], rows[_mirrored(y - radius_px, height)]
        for i in range(len(inner)):
            inner[i] += abs(coming[i])
        _mirror_ends(columns, width, channels, radius_px)
        for c in range(channels):
            box[c] = columns[c : 2 * margin + channels : channels].sum()
        for i in range(channels, len(box)):
            box[i] = box[i - channels] + columns[i + 2 * margin] - columns[i - channels]
        _mark_row(found[y], rows[y], box, limit, channels)
        for i in range(len(inner)):
            inner[i] -= abs(going[i])


@njit(cache=True, nogil=True)
def _mark_row(found: np.ndarray, values: np.ndarray, box: np.ndarray, limit: float, channels: int) -> None:
    """Mark pixels that exceed their limit; stretches without any are passed in vectors."""
    stretch = _STRETCH_PX * channels
    for first in range(0, len(values), stretch):
        here, around, count = values[first : first + stretch], box[first : first + stretch], 0
        for i in range(len(here)):
            count += abs(here[i]) > limit * around[i]
        if count > 0:
            for i in range(len(here)):
                found[(first + i) // channels] |= abs(here[i]) > limit * around[i]


@njit(cache=True, nogil=True)
def _mirror_ends(columns: np.ndarray, width: int, channels: int, radius_px: int) -> None:
    """Fill the margins of a row of pixels."""
    for x in range(-radius_px, 0):
        right = width - 1 - x
        for c in range(channels):
            columns[(x + radius_px) * channels + c] = columns[(_mirrored(x, width) + radius_px) * channels + c]
            columns[(right + radius_px) * channels + c] = columns[(_mirrored(right, width) + radius_px) * channels + c]


@njit(cache=True, nogil=True)
def pivots(diagonal: np.ndarray, height: int) -> np.ndarray:
    """Return (height, modes) reciprocal pivots of Thomas's elimination for rows -u[y-1] + diagonal u[y] - u[y+1].

    diagonal: (modes,), at least 2.
    """
    modes = diagonal.shape[0]
    out = np.empty((height, modes))
    for k in range(modes):
        out[0, k] = 1.0 / diagonal[k]
    for y in range(1, height):
        for k in range(modes):
            out[y, k] = 1.0 / (diagonal[k] - out[y - 1, k])
    return out


@njit(cache=True, nogil=True)
def solve_columns(modes: np.ndarray, pivot: np.ndarray, scale: np.ndarray, first: int, end: int) -> None:
    """Overwrite the right-hand sides modes[:, first:end] (H, K, C), times scale (K,), with the solutions; zero beyond both ends."""
    height, _, channels = modes.shape
    for y in range(height):
        for k in range(first, end):
            factor, onwards = scale[k] * pivot[y, k], pivot[y, k]
            for c in range(channels):
                before = modes[y - 1, k, c] if y > 0 else modes.dtype.type(0)
                modes[y, k, c] = factor * modes[y, k, c] + onwards * before
    for y in range(height - 2, -1, -1):
        for k in range(first, end):
            onwards = pivot[y, k]
            for c in range(channels):
                modes[y, k, c] += onwards * modes[y + 1, k, c]


@njit(cache=True, nogil=True)
def _uniform(state: np.ndarray) -> float:
    """Return a number in [0, 1) from a state (1,) uint64: SplitMix64 (Steele, Lea and Flood 2014)."""
    state[0] += np.uint64(0x9E3779B97F4A7C15)
    z = state[0]
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return float((z ^ (z >> np.uint64(31))) >> np.uint64(11)) / 9007199254740992.0


@njit(cache=True, nogil=True)
def throw_darts(xy: np.ndarray, importance: np.ndarray, radius_px: np.ndarray, failures: int, seed: int) -> np.ndarray:
    """Return indices of pixels drawn by importance, each kept if no earlier one is within the smaller radius of both.

    Ends after so many failures in a row.
    """
    state = np.array([seed], np.uint64)
    total = np.cumsum(importance)
    kept = np.empty(xy.shape[0], np.int64)
    count = failed = 0
    while failed < failures and count < xy.shape[0]:
        dart = min(np.searchsorted(total, _uniform(state) * total[-1], side="right"), xy.shape[0] - 1)
        free = True
        for i in range(count):
            apart = (xy[dart, 0] - xy[kept[i], 0]) ** 2 + (xy[dart, 1] - xy[kept[i], 1]) ** 2
            least = min(radius_px[dart], radius_px[kept[i]])
            if apart == 0 or apart < least * least:
                free = False
                break
        if free:
            kept[count] = dart
            count += 1
            failed = 0
        else:
            failed += 1
    return kept[:count].copy()


@njit(cache=True, nogil=True)
def nearest(points: np.ndarray, xy: np.ndarray, owner: np.ndarray) -> None:
    """Set the point whose Voronoi cell holds each pixel; of two as near, the first."""
    for m in range(xy.shape[0]):
        best = np.inf
        for n in range(points.shape[0]):
            apart = (xy[m, 0] - points[n, 0]) ** 2 + (xy[m, 1] - points[n, 1]) ** 2
            if apart < best:
                best, owner[m] = apart, n


@njit(cache=True, nogil=True)
def relax(points: np.ndarray, xy: np.ndarray, importance: np.ndarray, steps: int) -> None:
    """Move points (floating) to the centroids of their cells, weighted by importance, so many times (Lloyd)."""
    owner = np.empty(xy.shape[0], np.int64)
    sums = np.empty((points.shape[0], 3))
    for _ in range(steps):
        nearest(points, xy, owner)
        sums[:] = 0.0
        for m in range(xy.shape[0]):
            sums[owner[m], 0] += importance[m] * xy[m, 0]
            sums[owner[m], 1] += importance[m] * xy[m, 1]
            sums[owner[m], 2] += importance[m]
        for n in range(points.shape[0]):
            if sums[n, 2] > 0.0:
                points[n, 0], points[n, 1] = sums[n, 0] / sums[n, 2], sums[n, 1] / sums[n, 2]


@njit(cache=True, nogil=True)
def cell_sums(points: np.ndarray, xy: np.ndarray, charges: np.ndarray) -> np.ndarray:
    """Return (N, C) sums of the charges in the Voronoi cell of every point."""
    owner = np.empty(xy.shape[0], np.int64)
    nearest(points, xy, owner)
    values = np.zeros((points.shape[0], charges.shape[1]))
    for m in range(xy.shape[0]):
        for c in range(charges.shape[1]):
            values[owner[m], c] += charges[m, c]
    return values


@njit(cache=True, nogil=True)
def cost(points: np.ndarray, values: np.ndarray, potential: np.ndarray, table: np.ndarray, radius_px: int) -> float:
    """Return the squared error of the integrated sum of points, less a constant: v K v - 2 v (K L).

    potential (S, S, C): K L around the middle pixel (radius_px, radius_px). table: K by whole distances |x|, |y|.
    """
    total = 0.0
    for i in range(points.shape[0]):
        for c in range(values.shape[1]):
            inner = 0.0
            for j in range(points.shape[0]):
                inner += table[abs(points[i, 1] - points[j, 1]), abs(points[i, 0] - points[j, 0])] * values[j, c]
            total += values[i, c] * (inner - 2.0 * potential[points[i, 1] + radius_px, points[i, 0] + radius_px, c])
    return total


@njit(cache=True, nogil=True)
def _merged(points: np.ndarray) -> np.ndarray:
    """Return the points without those that lie on an earlier one."""
    kept = np.empty_like(points)
    count = 0
    for i in range(points.shape[0]):
        new = True
        for j in range(count):
            new = new and (points[i, 0] != kept[j, 0] or points[i, 1] != kept[j, 1])
        if new:
            kept[count] = points[i]
            count += 1
    return kept[:count].copy()


@njit(cache=True, nogil=True)
def anneal(
    points: np.ndarray,
    xy: np.ndarray,
    charges: np.ndarray,
    potential: np.ndarray,
    table: np.ndarray,
    radius_px: int,
    steps: int,
    moved_share: float,
    heat: float,
    seed: int,
) -> np.ndarray:
    """Move a share of the points by at most a pixel, `steps` times; keep what lowers the cost, or raises it by no more than chance allows.

    heat: temperature at the first step as a share of the first cost's distance to the best possible; it falls linearly to 0.
    """
    state = np.array([seed], np.uint64)
    points = _merged(points)
    values = cell_sums(points, xy, charges)
    now = cost(points, values, potential, table, radius_px)
    best, best_points = now, points.copy()
    for step in range(steps):
        tried = points.copy()
        for _ in range(max(1, int(moved_share * points.shape[0]))):
            i = int(_uniform(state) * points.shape[0])
            for axis in range(2):
                place = tried[i, axis] + int(_uniform(state) * 3.0) - 1
                tried[i, axis] = min(max(place, -radius_px), radius_px)
        tried = _merged(tried)
        values = cell_sums(tried, xy, charges)
        then = cost(tried, values, potential, table, radius_px)
        temperature = heat * (1.0 - step / steps)
        if then <= now or (temperature > 0.0 and _uniform(state) < math.exp((now - then) / temperature)):
            points, now = tried, then
            if now < best:
                best, best_points = now, points.copy()
    return best_points


@njit(cache=True, nogil=True)
def solve(matrix: np.ndarray, right: np.ndarray) -> bool:
    """Overwrite right (N, C) with the solution of matrix (N, N), which is used up, by elimination with partial pivoting; False if
    it is singular. LAPACK's would call all cores for every system: 70 times as slow where many are solved side by side."""
    count = matrix.shape[0]
    for k in range(count):
        pivot = k + np.argmax(np.abs(matrix[k:, k]))
        if matrix[pivot, k] == 0.0:
            return False
        if pivot != k:
            for j in range(k, count):
                matrix[k, j], matrix[pivot, j] = matrix[pivot, j], matrix[k, j]
            for c in range(right.shape[1]):
                right[k, c], right[pivot, c] = right[pivot, c], right[k, c]
        for i in range(k + 1, count):
            factor = matrix[i, k] / matrix[k, k]
            if factor != 0.0:
                matrix[i, k + 1 :] -= factor * matrix[k, k + 1 :]
                right[i] -= factor * right[k]
    for k in range(count - 1, -1, -1):
        for j in range(k + 1, count):
            right[k] -= matrix[k, j] * right[j]
        right[k] /= matrix[k, k]
    return True
