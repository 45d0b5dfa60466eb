"""Exact scatter of single pixels with tabulated 2D kernels; what the low-rank sum must not touch goes this way."""

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True)
def _blend(kernel: np.ndarray, taps: np.ndarray, starts: np.ndarray, radii_px: np.ndarray, lower: int, upper: float, channels: int) -> int:
    """Write (1 - upper) of kernel `lower` and upper of the next into kernel, every tap once per channel; returns the radius."""
    above = lower + 1 if upper > 0 else lower
    radius_px = radii_px[above]
    size, inset = 2 * radius_px + 1, radius_px - radii_px[lower]
    below = 2 * radii_px[lower] + 1
    for j in range(size):
        for i in range(size):
            tap = upper * taps[starts[above] + j * size + i] if upper > 0 else np.float32(0)
            if 0 <= j - inset < below and 0 <= i - inset < below:
                tap += (np.float32(1) - upper) * taps[starts[lower] + (j - inset) * below + i - inset]
            at = (j * size + i) * channels
            for c in range(channels):
                kernel[at + c] = tap
    return radius_px


@njit(cache=True, nogil=True, fastmath={"contract"})
def _add_row(out: np.ndarray, taps: np.ndarray, light: np.ndarray) -> None:
    for i in range(out.shape[0]):
        out[i] += taps[i] * light[i]


@njit(cache=True, nogil=True)
def splat_pixels(
    out: np.ndarray,
    values: np.ndarray,
    shares: np.ndarray,
    ys: np.ndarray,
    xs: np.ndarray,
    lowers: np.ndarray,
    uppers: np.ndarray,
    taps: np.ndarray,
    starts: np.ndarray,
    radii_px: np.ndarray,
    top: int,
    left: int,
) -> None:
    """Add share * value * kernel of every listed pixel to out (h, w * C), whose first pixel lies at row `top`, column `left`.

    ys, xs, lowers, uppers: (N,). taps: of all kernels, (2 r + 1)^2 from starts[i] on for kernel i.
    out must hold all the kernels. Pixels of equal diameter that follow one another share the blending of their kernel.
    """
    channels = values.shape[2]
    longest = 2 * radii_px.max() + 1
    kernel = np.empty(longest * longest * channels, np.float32)
    light = np.empty(longest * channels, np.float32)
    radius_px = 0
    for n in range(ys.shape[0]):
        if n == 0 or lowers[n] != lowers[n - 1] or uppers[n] != uppers[n - 1]:
            radius_px = _blend(kernel, taps, starts, radii_px, lowers[n], uppers[n], channels)
        size = 2 * radius_px + 1
        for i in range(size):
            for c in range(channels):
                light[i * channels + c] = shares[n] * values[ys[n], xs[n], c]
        length = size * channels
        start = (xs[n] - left - radius_px) * channels
        for j in range(size):
            row = out[ys[n] - top - radius_px + j]
            _add_row(row[start : start + length], kernel[j * length : (j + 1) * length], light[:length])
