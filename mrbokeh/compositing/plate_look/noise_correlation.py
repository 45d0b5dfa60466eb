"""How noise hangs together: between neighbours (demosaicing and compression smear it) and between channels."""

from functools import cache

import numpy as np
from jaxtyping import Float64

from mrbokeh.compositing.plate_look.noise_blocks import BLOCK_PX, NoiseBlocks, smooth_basis
from mrbokeh.compositing.plate_look.noise_level import NoiseLevel

REACH_PX = 4
LAGS = 2 * REACH_PX + 1
_MOST_BLOCKS = 4000  # a million pixels
Correlation = Float64[np.ndarray, "lags lags 3 3"]
"""[REACH_PX + dy, REACH_PX + dx, i, j]: mean of n_i(y, x) n_j(y + dy, x + dx) for noise of variance 1; beyond the reach it is 0."""


def white() -> Correlation:
    """Every pixel and every channel for itself."""
    result = np.zeros((LAGS, LAGS, 3, 3))
    result[REACH_PX, REACH_PX] = np.eye(3)
    return result


def measured_correlation(blocks: NoiseBlocks, level: NoiseLevel) -> tuple[Correlation, Float64[np.ndarray, "3"]]:
    """The correlation, and by how much the variance of each channel is larger than `level` says.

    What the paraboloid of a block took out is put back: with P the projection on smooth surfaces, residuals have the covariance
    (1 - P) C (1 - P), which is linear in the wanted values of C. Blocks without noise, or too few to tell, give white noise as it came.
    """
    products = _mean_products(blocks, level)
    covariance = np.linalg.solve(_residual_from_true(), products.reshape(LAGS * LAGS, 9)).reshape(LAGS, LAGS, 3, 3)
    # n_i(p) n_j(p + d) is n_j(q) n_i(q - d): both say the same.
    covariance = 0.5 * (covariance + covariance[::-1, ::-1].transpose(0, 1, 3, 2))
    variance = np.diagonal(covariance[REACH_PX, REACH_PX]).copy()
    if not (variance > 0.0).all():
        return white(), np.ones(3)
    deviation = np.sqrt(variance)
    return covariance / (deviation[:, None] * deviation), variance


def _mean_products(blocks: NoiseBlocks, level: NoiseLevel) -> Correlation:
    """Means over all pairs of pixels of a lag, of residuals in units of their standard deviation."""
    step = -(-len(blocks.level) // _MOST_BLOCKS)
    expected = level.variance(blocks.level[::step])
    scaled = blocks.residual[::step] * (1.0 / np.sqrt(np.maximum(expected, 1e-30))).astype(np.float32)[..., None]
    scaled[expected <= 1e-14] = 0.0
    planes = scaled.reshape(-1, 3, BLOCK_PX, BLOCK_PX)
    spectrum = np.fft.rfft2(planes, (2 * BLOCK_PX, 2 * BLOCK_PX))
    cross = np.einsum("niyx,njyx->ijyx", spectrum.conj(), spectrum)
    sums = np.fft.irfft2(cross, (2 * BLOCK_PX, 2 * BLOCK_PX))
    lags = np.arange(-REACH_PX, REACH_PX + 1)
    pairs = (BLOCK_PX - np.abs(lags))[:, None] * (BLOCK_PX - np.abs(lags)) * len(planes)
    return sums[:, :, lags][..., lags].transpose(2, 3, 0, 1) / pairs[..., None, None]


@cache
def _residual_from_true() -> Float64[np.ndarray, "lags2 lags2"]:
    """What a covariance of 1 at one lag (column) makes of the mean products of residuals at each (row)."""
    masks = np.stack([_pairs_of_lag(dy, dx) for dy in range(-REACH_PX, REACH_PX + 1) for dx in range(-REACH_PX, REACH_PX + 1)])
    counts = masks.sum(axis=(1, 2))
    seen = np.stack([_without_smooth(mask).ravel() for mask in masks])
    return (masks.reshape(len(masks), -1) @ seen.T) / counts[:, None]


def _without_smooth(covariance: Float64[np.ndarray, "pixels pixels"]) -> Float64[np.ndarray, "pixels pixels"]:
    """(1 - P) C (1 - P), by way of the few columns of the basis."""
    basis = smooth_basis()
    left, right = basis.T @ covariance, covariance @ basis
    return covariance - basis @ left - right @ basis.T + basis @ (left @ basis) @ basis.T


def _pairs_of_lag(dy: int, dx: int) -> Float64[np.ndarray, "pixels pixels"]:
    """1 where the second pixel of a block lies (dy, dx) from the first."""
    y, x = (each.ravel() for each in np.mgrid[:BLOCK_PX, :BLOCK_PX])
    return ((y[None] - y[:, None] == dy) & (x[None] - x[:, None] == dx)).astype(np.float64)
