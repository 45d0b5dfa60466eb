"""Compiled loops of `guided_depth`: weighted medians, and semi-global aggregation of costs in 0..255 along eight directions."""

import numpy as np

from mrbokeh.system.compiled import njit

_FAR = np.float32(1e9)


@njit(cache=True, nogil=True, error_model="numpy")
def weighted_medians(
    values: np.ndarray,
    weights: np.ndarray,
    guide: np.ndarray,
    where: np.ndarray,
    radius: int,
    contrast: float,
    rows: tuple[int, int],
    out: np.ndarray,
) -> None:
    """Replace each pixel marked in `where`, of rows first <= y < end, by the weighted median of its window.

    See `guided_depth.weighted_medians`.
    """
    height, width = values.shape
    colours = guide.shape[2]
    found = np.empty((2 * radius + 1) ** 2, np.float32)
    share = np.empty((2 * radius + 1) ** 2, np.float32)
    for y in range(rows[0], rows[1]):
        for x in range(width):
            if not where[y, x]:
                continue
            count, total = 0, 0.0
            for j in range(max(y - radius, 0), min(y + radius + 1, height)):
                for i in range(max(x - radius, 0), min(x + radius + 1, width)):
                    difference = 0.0
                    for c in range(colours):
                        step = guide[j, i, c] - guide[y, x, c]
                        difference += step * step
                    found[count] = values[j, i]
                    share[count] = weights[j, i] * np.exp(-difference / (contrast * contrast))
                    total += share[count]
                    count += 1
            if total <= 0.0:
                continue
            order = np.argsort(found[:count])
            passed = 0.0
            for place in range(count):
                passed += share[order[place]]
                if passed >= 0.5 * total:
                    out[y, x] = found[order[place]]
                    break


@njit(cache=True, nogil=True, error_model="numpy")
def _step(before: np.ndarray, cost: np.ndarray, small: np.float32, large: np.float32, path: np.ndarray) -> None:
    """Compute the path cost of each label of this pixel from the previous one.

    Both arrays carry a margin of one on either side, and the least cost of all labels at their end.
    """
    count = cost.shape[0]
    cheapest = before[count + 2]
    jump = cheapest + large
    least = _FAR
    for label in range(count):
        best = min(min(before[label + 1], jump), min(before[label], before[label + 2]) + small)
        value = np.float32(cost[label]) + best - cheapest
        path[label + 1] = value
        least = min(least, value)
    path[count + 2] = least


@njit(cache=True, nogil=True, error_model="numpy")
def _sweep(
    costs: np.ndarray, guide: np.ndarray, direction: tuple[int, int], small: float, large: float, contrast: float, total: np.ndarray
) -> None:
    """Add the path costs of one direction; costs and total are (H, W, L)."""
    height, width, labels = costs.shape
    dx, dy = direction
    small32, large32 = np.float32(small), np.float32(large)
    above = np.full((width, labels + 3), _FAR, np.float32)
    row = np.full((width, labels + 3), _FAR, np.float32)
    start = np.full(labels + 3, np.float32(0.0))
    start[0], start[labels + 1] = _FAR, _FAR
    for step_y in range(height):
        y = step_y if dy >= 0 else height - 1 - step_y
        for step_x in range(width):
            x = step_x if dx >= 0 else width - 1 - step_x
            from_x, from_y = x - dx, y - dy
            if from_x < 0 or from_x >= width or from_y < 0 or from_y >= height:
                _step(start, costs[y, x], small32, large32, row[x])
            else:
                edge = abs(guide[y, x] - guide[from_y, from_x])
                penalty = max(large32 / (np.float32(1.0) + edge / np.float32(contrast)), small32)
                _step(row[from_x] if dy == 0 else above[from_x], costs[y, x], small32, penalty, row[x])
            for label in range(labels):
                total[y, x, label] += np.uint16(row[x, label + 1])
        above, row = row, above


@njit(cache=True, nogil=True, error_model="numpy")
def aggregate(costs: np.ndarray, guide: np.ndarray, small: float, large: float, contrast: float) -> np.ndarray:
    """Sum (H, W, L) uint8 costs over eight paths as uint16, rounded down path by path."""
    total = np.zeros(costs.shape, np.uint16)
    for direction in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        _sweep(costs, guide, direction, small, large, contrast, total)
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def winners(total: np.ndarray, apart: int, index: np.ndarray, margin: np.ndarray) -> None:
    """Find per pixel the fractional index of the cheapest label, and the lead over the cheapest one more than `apart` labels away."""
    height, width, labels = total.shape
    for y in range(height):
        for x in range(width):
            cost = total[y, x]
            best = 0
            for label in range(1, labels):
                if cost[label] < cost[best]:
                    best = label
            rival = np.float32(65535.0)
            for label in range(labels):
                if abs(label - best) > apart:
                    rival = min(rival, np.float32(cost[label]))
            here = np.float32(cost[best])
            margin[y, x] = rival - here
            index[y, x] = best
            if 0 < best < labels - 1:
                before, after = np.float32(cost[best - 1]), np.float32(cost[best + 1])
                bend = before + after - np.float32(2.0) * here
                if bend > 0:
                    index[y, x] += min(max(np.float32(0.5) * (before - after) / bend, np.float32(-0.5)), np.float32(0.5))
