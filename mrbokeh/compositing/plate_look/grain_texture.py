"""A periodic texture of normal noise with a given correlation between neighbours and channels."""

import numpy as np
from jaxtyping import Complex128, Float32

from mrbokeh.compositing.plate_look.noise_correlation import REACH_PX, Correlation

SIDE_PX = 1024
_GRID_PX = 32


def grain_texture(correlation: Correlation, seed: int) -> Float32[np.ndarray, "side side 3"]:
    """White noise, filtered by the root of the spectrum that belongs to the correlation (Wiener-Khinchin); mean 0, variance 1."""
    kernels = np.fft.irfft2(_root_of_spectrum(correlation), (_GRID_PX, _GRID_PX), axes=(0, 1))
    noise = np.random.default_rng(seed).standard_normal((SIDE_PX, SIDE_PX, 3), np.float32)
    drawn = np.fft.rfft2(noise, axes=(0, 1))
    mixed = np.zeros_like(drawn)
    for i, j in np.ndindex(3, 3):
        mixed[..., i] += np.fft.rfft2(_placed(kernels[..., i, j])) * drawn[..., j]
    texture = np.fft.irfft2(mixed, (SIDE_PX, SIDE_PX), axes=(0, 1))
    texture -= texture.mean(axis=(0, 1))
    deviation = texture.std(axis=(0, 1))
    return (texture / np.where(deviation > 0.0, deviation, 1.0)).astype(np.float32)


def _root_of_spectrum(correlation: Correlation) -> Complex128[np.ndarray, "rows columns 3 3"]:
    """The Hermitian root per frequency. Cutting a correlation off may make a spectrum slightly negative: there it is taken as 0."""
    grid = np.zeros((_GRID_PX, _GRID_PX, 3, 3))
    places = np.arange(-REACH_PX, REACH_PX + 1)
    grid[np.ix_(places, places)] = correlation
    # n_i(p) n_j(p + d) summed with exp(-i f d) has conj(N_i) N_j; the filter's spectrum is N_i conj(N_j).
    spectrum = np.fft.rfft2(grid, axes=(0, 1)).conj()
    values, vectors = np.linalg.eigh(0.5 * (spectrum + spectrum.conj().swapaxes(2, 3)))
    return (vectors * np.sqrt(np.maximum(values, 0.0))[..., None, :]) @ vectors.conj().swapaxes(2, 3)


def _placed(kernel: np.ndarray) -> np.ndarray:
    """A kernel about pixel (0, 0), on the side of the texture."""
    half = _GRID_PX // 2
    places = np.arange(-half, half)
    whole = np.zeros((SIDE_PX, SIDE_PX))
    whole[np.ix_(places, places)] = kernel[np.ix_(places, places)]
    return whole
