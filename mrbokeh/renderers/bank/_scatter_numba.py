"""The loop over pixels of a bank's plain twin, compiled; same words, nothing cleverer."""

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True)
def scatter_blended(
    padded: np.ndarray,
    values: np.ndarray,
    numbers: np.ndarray,
    weights: np.ndarray,
    taps: np.ndarray,
    starts: np.ndarray,
    radii_px: np.ndarray,
    margin_px: int,
) -> None:
    """Add values (H, W, C), each spread by the weighted kernels with its pixel's numbers (H, W, N), to padded, which has a margin."""
    height, width, channels = values.shape
    for y in range(height):
        for x in range(width):
            for n in range(numbers.shape[2]):
                weight, number = weights[y, x, n], numbers[y, x, n]
                if weight == 0.0:
                    continue
                radius_px, at = radii_px[number], starts[number]
                for j in range(y + margin_px - radius_px, y + margin_px + radius_px + 1):
                    for i in range(x + margin_px - radius_px, x + margin_px + radius_px + 1):
                        for c in range(channels):
                            padded[j, i, c] += taps[at] * weight * values[y, x, c]
                        at += 1
