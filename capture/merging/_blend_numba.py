"""The blend of slices by focus index, one slice at a time, compiled."""

import numpy as np
from numba import njit


@njit(cache=True)
def add_weighted(blended: np.ndarray, rgb: np.ndarray, focus_index: np.ndarray, index: float, crossover: float) -> None:
    """Add the share of slice `index` (see `all_in_focus.slice_weight`) in place; blended, rgb (H, W, 3), focus_index (H, W)."""
    height, width = focus_index.shape
    for y in range(height):
        for x in range(width):
            weight = min(max((0.5 - abs(focus_index[y, x] - index)) / crossover + 0.5, 0.0), 1.0)
            if weight > 0.0:
                for channel in range(3):
                    blended[y, x, channel] += np.float32(weight) * rgb[y, x, channel]
