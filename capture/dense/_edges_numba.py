"""Weighted median around the edges of a depth map, compiled."""

import numpy as np

from mrbokeh.system.kernels import njit


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
    """For each pixel of rows first <= y < end marked in `where`: see `dense_edges.weighted_medians_plainly`, the twin."""
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
