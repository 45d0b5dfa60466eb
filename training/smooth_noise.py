"""Smooth random fields, for errors that vary slowly over a picture."""

import functools

import numpy as np
from jaxtyping import Float32

_SIGMA_IN_CELLS = 0.7  # two cells away little is left, and the grid does not show


def smooth_noise(size_px: tuple[int, int], cell_px: float, rng: np.random.Generator) -> Float32[np.ndarray, "height width"]:
    """(height, width), normally distributed with mean 0 and variance 1 at every pixel; values a cell apart have little to do with another.

    White noise on a grid, spread by Gaussians; each row of weights has a sum of squares of 1, so that the variance is exact.
    """
    down, across = (_weights(length, cell_px) for length in size_px)
    grid = rng.standard_normal((down.shape[1], across.shape[1]), dtype=np.float32)
    return np.asarray(down @ grid @ across.T)


def octaves(size_px: tuple[int, int], cell_px: float, count: int, rng: np.random.Generator) -> Float32[np.ndarray, "height width"]:
    """Add up octaves as Perlin's noise does: each with half the cell and half the amplitude of the last; mean 0, variance 1."""
    amplitudes = 0.5 ** np.arange(count)
    fields = [amplitude * smooth_noise(size_px, cell_px * amplitude, rng) for amplitude in amplitudes.tolist()]
    return np.asarray(sum(fields) / np.float32(np.linalg.norm(amplitudes)), np.float32)


@functools.lru_cache(maxsize=64)
def _weights(length_px: int, cell_px: float) -> Float32[np.ndarray, "pixels nodes"]:
    nodes = np.arange(-2, int(np.ceil(length_px / cell_px)) + 3) * cell_px
    offsets = (np.arange(length_px) + 0.5)[:, None] - nodes
    weights = np.exp(-0.5 * (offsets / (_SIGMA_IN_CELLS * cell_px)) ** 2)
    return np.asarray(weights / np.linalg.norm(weights, axis=1, keepdims=True), np.float32)
