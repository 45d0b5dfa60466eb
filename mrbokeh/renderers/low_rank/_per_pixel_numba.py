"""McGraw's passes, compiled: across with the kernel of the source, down with the kernel of the pixel that was reached."""

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True)
def _blended(taps: np.ndarray, table: np.ndarray, position: float) -> None:
    """taps (K,) between two neighbouring rows of a table (levels, K)."""
    level = min(int(position), table.shape[0] - 2)
    upper = np.float32(position - level)
    for j in range(taps.shape[0]):
        taps[j] = (np.float32(1) - upper) * table[level, j] + upper * table[level + 1, j]


@njit(cache=True, nogil=True)
def _radius_px(radii_px: np.ndarray, position: float) -> int:
    return radii_px[min(int(np.ceil(position)), radii_px.shape[0] - 1)]


@njit(cache=True, nogil=True)
def across(
    middle: np.ndarray, values: np.ndarray, shares: np.ndarray, positions: np.ndarray, table: np.ndarray, radii_px: np.ndarray
) -> None:
    """Overwrite middle (h, W, C) with share * value of each pixel (h, W, C) thrown along its row by its own taps.

    positions (h, W): level of each pixel's diameter, a fraction between two rows of table (levels, K), whose taps lie
    around the middle of K, no farther than radii_px (levels,).
    """
    height, width, channels = values.shape
    taps = np.empty(table.shape[1], np.float32)
    centre = table.shape[1] // 2
    middle[:] = np.float32(0)
    for y in range(height):
        for x in range(width):
            if shares[y, x] > 0:
                _blended(taps, table, positions[y, x])
                radius_px = _radius_px(radii_px, positions[y, x])
                for to in range(max(0, x - radius_px), min(width, x + radius_px + 1)):
                    tap = shares[y, x] * taps[centre + to - x]
                    for c in range(channels):
                        middle[y, to, c] += tap * values[y, x, c]


@njit(cache=True, nogil=True)
def down(out: np.ndarray, middle: np.ndarray, positions: np.ndarray, table: np.ndarray, radii_px: np.ndarray) -> None:
    """Add middle (H, w, C) to out, each pixel thrown along its column by the taps of the place where it is."""
    height, width, channels = middle.shape
    taps = np.empty(table.shape[1], np.float32)
    centre = table.shape[1] // 2
    for y in range(height):
        for x in range(width):
            lit = False
            for c in range(channels):
                lit = lit or middle[y, x, c] != 0
            if lit:
                _blended(taps, table, positions[y, x])
                radius_px = _radius_px(radii_px, positions[y, x])
                for to in range(max(0, y - radius_px), min(height, y + radius_px + 1)):
                    tap = taps[centre + to - y]
                    for c in range(channels):
                        out[to, x, c] += tap * middle[y, x, c]
