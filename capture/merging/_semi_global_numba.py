"""Semi-global aggregation of label costs along eight directions, compiled."""

import numpy as np
from numba import njit


@njit(cache=True)
def _step(previous: np.ndarray, cost: np.ndarray, small: float, large: float, path: np.ndarray) -> None:
    """Cheapest way to each label of this pixel from any label of the previous pixel of the path."""
    count = cost.shape[0]
    cheapest = previous[0]
    for label in range(1, count):
        cheapest = min(cheapest, previous[label])
    for label in range(count):
        best = min(previous[label], cheapest + large)
        if label > 0:
            best = min(best, previous[label - 1] + small)
        if label < count - 1:
            best = min(best, previous[label + 1] + small)
        path[label] = cost[label] + best - cheapest


@njit(cache=True)
def _sweep(costs: np.ndarray, total: np.ndarray, dx: int, dy: int, small: float, large: float) -> None:
    """Add the path costs of one direction; costs and total are (H, W, L)."""
    height, width, labels = costs.shape
    previous_row = np.zeros((width, labels))
    row = np.zeros((width, labels))
    for step_y in range(height):
        y = step_y if dy >= 0 else height - 1 - step_y
        for step_x in range(width):
            x = step_x if dx >= 0 else width - 1 - step_x
            from_x, from_y = x - dx, y - dy
            if from_x < 0 or from_x >= width or from_y < 0 or from_y >= height:
                row[x] = costs[y, x]
            elif dy == 0:
                _step(row[from_x], costs[y, x], small, large, row[x])
            else:
                _step(previous_row[from_x], costs[y, x], small, large, row[x])
            total[y, x] += row[x]
        previous_row, row = row, previous_row


@njit(cache=True)
def _all_sweeps(costs: np.ndarray, small: float, large: float) -> np.ndarray:
    total = np.zeros_like(costs)
    for dx, dy in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        _sweep(costs, total, dx, dy, small, large)
    return total


def aggregate_costs(costs: np.ndarray, small: float, large: float) -> np.ndarray:
    """(L, H, W) float32 costs of each label to their sums over eight paths (L, H, W), float32."""
    return np.moveaxis(_all_sweeps(np.ascontiguousarray(np.moveaxis(costs, 0, -1)), small, large), -1, 0)
