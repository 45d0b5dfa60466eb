"""Compiled parts of kernel rectification: the cheapest closed walks from line to line around an outline.

starts, targets, areas: the arcs, line after line, as `mrbokeh.renderers.polygon._rectification_corners_numba.corners` gives them.
"""

import numpy as np

from mrbokeh.system.kernels import njit

ALIKE = 1e-12
"""Areas closer than this are the same; of such walks the one with fewer lines is taken."""


@njit(cache=True)
def _still_to_pay(period: int, origins: np.ndarray, starts: np.ndarray, targets: np.ndarray, areas: np.ndarray, most: int) -> np.ndarray:
    """(most + 1, 2 period): the least that a walk costs from each line to the image of any origin, with at most so many more lines."""
    least = np.full((most + 1, 2 * period), np.inf)
    for origin in origins:
        least[:, origin + period] = 0.0
    for n in range(1, most + 1):
        for line in range(2 * period - 1, -1, -1):
            base, shift = line % period, line - line % period
            price = min(least[n, line], least[n - 1, line])
            for k in range(starts[base], starts[base + 1]):
                if targets[k] + shift >= 2 * period:
                    break
                price = min(price, areas[k] + least[n - 1, targets[k] + shift])
            least[n, line] = price
    return least


@njit(cache=True)
def cheapest_turn(period: int, origins: np.ndarray, starts: np.ndarray, targets: np.ndarray, areas: np.ndarray, most: int) -> np.ndarray:
    """The lines of the cheapest walk from one of `origins` to its image one period later, of at most `most` lines; empty if none.

    Lines 0..period-1 are one period of the outline, period..2 period-1 the next. Walks that cannot become cheaper than the
    best one so far, even if they might end at any origin, are given up; that leaves little to do after the first origin.
    """
    best, found = np.inf, np.empty(0, np.int64)
    least = _still_to_pay(period, origins, starts, targets, areas, most)
    cost, source = np.empty((most + 1, 2 * period)), np.empty((most + 1, 2 * period), np.int64)
    for origin in origins[np.argsort(least[most][origins])]:
        if least[most, origin] >= best - ALIKE:
            break
        cost[:] = np.inf
        cost[0, origin] = 0.0
        for line in range(origin, origin + period):
            base, shift = line % period, line - line % period
            for n in range(most):
                if cost[n, line] + least[most - n, line] >= best - ALIKE:
                    continue
                for k in range(starts[base], starts[base + 1]):
                    target, price = targets[k] + shift, cost[n, line] + areas[k]
                    if target > origin + period:
                        break
                    if price < cost[n + 1, target]:
                        cost[n + 1, target], source[n + 1, target] = price, line
        for n in range(1, most + 1):
            if cost[n, origin + period] < best - ALIKE:
                best = cost[n, origin + period]
                found = _walk_back(source, n, origin + period, 0)
    return found


@njit(cache=True)
def cheapest_sector(
    first: np.ndarray, last: np.ndarray, starts: np.ndarray, targets: np.ndarray, areas: np.ndarray, most: int
) -> np.ndarray:
    """The lines of the cheapest walk from one mirror axis to the next; empty if none has at most `most` lines with its mirror image.

    first, last: (lines, 2), what a line costs as the first or last one where it makes a corner with its own image on the axis
    (column 0) or is its own image (column 1); inf where it cannot.
    """
    total = first.shape[0]
    cost, source = np.full((most + 2, total), np.inf), np.full((most + 2, total), -1, np.int64)
    cost[1], cost[2] = first[:, 1], first[:, 0]
    best, found = np.inf, np.empty(0, np.int64)
    for line in range(total):
        for n in range(1, most):
            if cost[n, line] == np.inf:
                continue
            for k in range(starts[line], starts[line + 1]):
                target, price = targets[k], cost[n, line] + areas[k]
                if n + 2 <= most + 1 and price < cost[n + 2, target]:
                    cost[n + 2, target], source[n + 2, target] = price, line
    for used in range(1, most + 1):
        for line in range(total):
            for own in range(2):
                if cost[used + own, line] + last[line, own] < best - ALIKE:
                    best = cost[used + own, line] + last[line, own]
                    found = _walk_back(source, used + own, line, -1)
    return found


@njit(cache=True)
def _walk_back(source: np.ndarray, n: int, line: int, stop: int) -> np.ndarray:
    """Follow `source` back to the start of the walk: by one per line to n = stop, or by two where stop is -1."""
    walk = np.empty(n + 1, np.int64)
    size = 0
    while n > 0 if stop == 0 else line >= 0:
        if stop == 0:
            line = source[n, line]
            n -= 1
            walk[size] = line
        else:
            walk[size] = line
            line = source[n, line]
            n -= 2
        size += 1
    return walk[:size][::-1].copy()
