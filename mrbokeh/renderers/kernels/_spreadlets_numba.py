"""Compiled loops of mrbokeh.renderers.kernels.spreadlets: darts, Lloyd's relaxation, sums over Voronoi cells, annealing.

Pixels of a Laplacian come as xy (M, 2) whole pixels with charges (M, C) and importance (M,); points as (N, 2).
"""

import math

import numpy as np

from mrbokeh.system.compiled import njit


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
