"""Variance of noise as a function of level, var = shot * level + read, from blocks of which many show more than noise.

A sensor counts photons (Poisson, variance in proportion to level) and adds what its electronics do (Gauss); Foi et al. 2008, "Practical
Poissonian-Gaussian noise modeling and fitting for single-image raw data". Texture only ever adds variance, so the blocks of noise
alone are the lowest heap at each level: the fit starts below it and climbs until it holds the heap.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float64

from mrbokeh.compositing.plate_look.colour_match import Triple, triple_of
from mrbokeh.compositing.plate_look.noise_blocks import BLOCK_PX, NoiseBlocks
from mrbokeh.system.errors import InputError

Blocks = Float64[np.ndarray, "blocks 3"]
LEAST_BLOCKS = 12
_START_QUANTILE, _BLOCKS_PER_BIN, _MOST_BINS, _ROUNDS = 0.15, 24, 24, 30
_KURTOSIS = (1.8, 4.6)
_DEVIATIONS = 3.0
_LEAST_SPREAD, _MOST_SPREAD = (2.0 / BLOCK_PX**2) ** 0.5, 0.35  # of a block's variance: independent pixels; grain 3 px wide


@dataclass(frozen=True)
class NoiseLevel:
    """Per channel, of linear values: shot (variance per level) and read (variance in the dark), neither below 0."""

    shot: Triple
    read: Triple

    def variance(self, level: Float[np.ndarray, "*batch 3"]) -> Float64[np.ndarray, "*batch 3"]:
        """Below black the noise is that of black."""
        return np.maximum(level, 0.0, dtype=np.float64) * np.array(self.shot) + np.array(self.read)


def fit_noise_level(blocks: NoiseBlocks) -> tuple[NoiseLevel, Bool[np.ndarray, " blocks"]]:
    """The level function, and which blocks show nothing but noise. Raises InputError where too few do."""
    flat = _flat(blocks)
    level, variance = blocks.level, blocks.variance
    start = [_line(*_bins(level[flat, c], variance[flat, c])) for c in range(3)]
    found, accepted = _as_noise(start), flat
    for _ in range(_ROUNDS):
        accepted, before = flat & _heap(variance, found.variance(level), flat), accepted
        _require(accepted)
        found = _as_noise([_line(level[accepted, c], variance[accepted, c]) for c in range(3)])
        if (accepted == before).all():
            break
    return found, accepted


def _flat(blocks: NoiseBlocks) -> Bool[np.ndarray, " blocks"]:
    """Usable, and without edges or specks by a test that no strength of noise can fail. Blocks without any variance are flat."""
    kurtosis = blocks.kurtosis
    normal = ((kurtosis > _KURTOSIS[0]) & (kurtosis < _KURTOSIS[1])) | (blocks.variance < 1e-14)
    flat = blocks.usable & normal.all(axis=1)
    _require(flat)
    return flat


def _require(chosen: Bool[np.ndarray, " blocks"]) -> None:
    if chosen.sum() < LEAST_BLOCKS:
        raise InputError(
            f"expected {LEAST_BLOCKS} or more smooth places of {BLOCK_PX}x{BLOCK_PX} px to measure grain in, found {int(chosen.sum())}: "
            f"take another frame of the same camera, or give the grain as a file"
        )


def _heap(variance: Blocks, expected: Blocks, flat: Bool[np.ndarray, " blocks"]) -> Bool[np.ndarray, " blocks"]:
    """Blocks within some deviations of what is expected, in every channel; the deviation is that of the blocks below: no texture there."""
    ratio = variance / np.maximum(expected, 1e-30)
    ratio[(variance < 1e-14) & (expected < 1e-14)] = 1.0
    below = np.where((ratio < 1.0) & flat[:, None], (1.0 - ratio) ** 2, np.nan)
    spread = np.sqrt(np.nanmean(below, axis=0)) if np.isfinite(below).any(axis=0).all() else np.full(3, _LEAST_SPREAD)
    reach = _DEVIATIONS * np.clip(spread, _LEAST_SPREAD, _MOST_SPREAD)
    return (np.abs(ratio - 1.0) <= reach).all(axis=1)


def _bins(level: Float64[np.ndarray, " blocks"], variance: Float64[np.ndarray, " blocks"]) -> tuple[np.ndarray, np.ndarray]:
    """Mean level and a low quantile of variance of bins of equally many blocks."""
    count = int(np.clip(len(level) // _BLOCKS_PER_BIN, 1, _MOST_BINS))
    parts = np.array_split(np.argsort(level, kind="stable"), count)
    return np.array([level[part].mean() for part in parts]), np.array([np.quantile(variance[part], _START_QUANTILE) for part in parts])


def _line(level: Float64[np.ndarray, " points"], variance: Float64[np.ndarray, " points"]) -> tuple[float, float]:
    """Slope and intercept, neither below 0, by least squares of relative errors: a variance is as uncertain as it is large."""
    from scipy.optimize import nnls

    level = np.maximum(level, 0.0)
    expected = np.full_like(variance, variance.mean())
    slope = intercept = 0.0
    for _ in range(8):
        weight = 1.0 / np.maximum(expected, 1e-3 * max(float(variance.mean()), 1e-30))
        (slope, intercept), _ = nnls(np.stack([level, np.ones_like(level)], axis=1) * weight[:, None], variance * weight)
        expected = slope * level + intercept
    return float(slope), float(intercept)


def _as_noise(lines: list[tuple[float, float]]) -> NoiseLevel:
    slopes, intercepts = zip(*lines, strict=True)
    return NoiseLevel(triple_of(np.array(slopes)), triple_of(np.array(intercepts)))
