"""Compiled loops of exact scattering, by apertures or by blended kernels of a bank: the plain formulas, nothing cleverer."""

import math

import numpy as np

from mrbokeh.optics._aperture_numba import fill_psf
from mrbokeh.system.compiled import njit

KEPT = 1 << 21
"""Weights of kernels that are kept at most."""


@njit(cache=True, nogil=True)
def scatter_rows(
    padded: np.ndarray,
    values: np.ndarray,
    coc_px: np.ndarray,
    margin_px: int,
    unit_radius: float,
    vertices: np.ndarray,
    starts: np.ndarray,
    weights: np.ndarray,
) -> None:
    """Add values (H, W, C), each blurred by its pixel's PSF, to padded, which has a margin of the largest kernel's radius.

    A column keeps its last kernel, which the pixel below often takes too.
    """
    height, width, channels = values.shape
    largest = (2 * margin_px + 1) ** 2
    kept = max(1, min(width, KEPT // largest))
    kernels, drawn_px, scratch = np.empty((kept, largest)), np.full(kept, np.nan), np.empty(largest)
    for y in range(height):
        for x in range(width):
            lit = False
            for c in range(channels):
                lit = lit or values[y, x, c] != 0.0
            if not lit:
                continue
            diameter_px = float(coc_px[y, x])
            radius_px = max(0, int(math.ceil(abs(diameter_px) * 0.5 * unit_radius - 0.5)))
            size = 2 * radius_px + 1
            kernel = kernels[x % kept, : size * size].reshape(size, size)
            if drawn_px[x % kept] != diameter_px:
                drawn_px[x % kept] = diameter_px
                fill_psf(kernel, scratch[: size * size].reshape(size, size), vertices, starts, weights, diameter_px)
            top, left = y + margin_px - radius_px, x + margin_px - radius_px
            for j in range(size):
                for i in range(size):
                    for c in range(channels):
                        padded[top + j, left + i, c] += kernel[j, i] * values[y, x, c]


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
    """Add values (H, W, C), each blurred by the weighted kernels with its pixel's numbers (H, W, N), to padded, which has a margin."""
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
