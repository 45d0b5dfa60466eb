"""Noise of a picture, measured in blocks: its variance by level, and its correlation between neighbours and channels.

A picture is cut into blocks; noise is what is left of each after subtracting a smooth surface. The variance is var = shot * level +
read: a sensor counts photons (Poisson, variance in proportion to level) and adds the noise of its electronics (Gauss); Foi et al. 2008,
"Practical Poissonian-Gaussian noise modeling and fitting for single-image raw data". Texture only ever adds variance, so the blocks of
noise alone are the lowest cluster at each level: the fit starts below it and climbs until it holds the cluster. Demosaicing and
compression correlate neighbours.
"""

from dataclasses import dataclass
from functools import cache

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64

from mrbokeh.compositing.plate_look.colour_match import Triple, triple_of
from mrbokeh.system.errors import InputError

Picture = Float32[np.ndarray, "height width 3"]
BLOCK_PX = 16
_MOST_BLOCKS = 20000

Blocks = Float64[np.ndarray, "blocks 3"]
LEAST_BLOCKS = 12
_START_QUANTILE, _BLOCKS_PER_BIN, _MOST_BINS, _ROUNDS = 0.15, 24, 24, 30
_KURTOSIS = (1.8, 4.6)
_DEVIATIONS = 3.0
_LEAST_SPREAD, _MOST_SPREAD = (2.0 / BLOCK_PX**2) ** 0.5, 0.35  # of a block's variance: independent pixels; grain 3 px wide
REACH_PX = 4
LAGS = 2 * REACH_PX + 1
_MOST_CORRELATED_BLOCKS = 4000  # a million pixels
Correlation = Float64[np.ndarray, "lags lags 3 3"]
"""[REACH_PX + dy, REACH_PX + dx, i, j]: mean of n_i(y, x) n_j(y + dy, x + dx) for noise of variance 1; beyond the reach it is 0."""


@dataclass(frozen=True)
class NoiseBlocks:
    """Blocks of a picture.

    residual: (N, 3, P) values of P = BLOCK_PX^2 pixels less the paraboloid that fits them best. level: (N, 3) their mean. usable: (N,)
    neither clipped nor, in a difference of frames, an exact copy.
    """

    level: Float64[np.ndarray, "blocks 3"]
    residual: Float32[np.ndarray, "blocks 3 pixels"]
    usable: Bool[np.ndarray, " blocks"]

    @property
    def variance(self) -> Float64[np.ndarray, "blocks 3"]:
        """Unbiased where neighbours are independent."""
        degrees = self.residual.shape[2] - smooth_basis().shape[1]
        return np.einsum("ncp,ncp->nc", self.residual, self.residual, dtype=np.float64) / degrees

    @property
    def kurtosis(self) -> Float64[np.ndarray, "blocks 3"]:
        """Kurtosis: 3 for normal noise of any strength; edges and specks have more. Independent of the variance (Basu's theorem)."""
        second = np.einsum("ncp,ncp->nc", self.residual, self.residual, dtype=np.float64)
        squares = self.residual.astype(np.float64) ** 2
        fourth = np.einsum("ncp,ncp->nc", squares, squares)
        return self.residual.shape[2] * fourth / np.maximum(second, 1e-30) ** 2

    def only(self, chosen: Bool[np.ndarray, " blocks"]) -> "NoiseBlocks":
        return NoiseBlocks(self.level[chosen], self.residual[chosen], self.usable[chosen])


def noise_blocks(rgb: Picture) -> NoiseBlocks:
    """Blocks of one picture; those that hold a channel's least or greatest value in several pixels are clipped."""
    blocks = _cut(rgb)
    rows = rgb.reshape(len(rgb), -1)  # row after row, which is ten times as fast as over both axes at once
    low, high = rows.min(axis=0).reshape(-1, 3).min(axis=0), rows.max(axis=0).reshape(-1, 3).max(axis=0)
    at_end = (blocks <= low[:, None]) | (blocks >= high[:, None])
    clipped = (at_end.sum(axis=2) > 2).any(axis=1) & (np.ptp(blocks, axis=2) > 0).any(axis=1)
    return _blocks(blocks, blocks.mean(axis=2, dtype=np.float64), ~clipped)


def noise_blocks_of_pair(first: Picture, second: Picture) -> NoiseBlocks:
    """Blocks of the difference of two frames of a still camera, divided by sqrt(2): the noise of one frame.

    What an encoder copied from frame to frame says nothing about noise and is not usable.
    """
    if first.shape != second.shape:
        raise InputError(
            f"expected two frames of one size, got {first.shape[1]}x{first.shape[0]} and {second.shape[1]}x{second.shape[0]} px"
        )
    mean = noise_blocks((0.5 * (first + second)).astype(np.float32))
    difference = _cut((second - first).astype(np.float32) / np.float32(np.sqrt(2.0)))
    copied = (difference == 0.0).mean(axis=2).min(axis=1) > 0.5
    return _blocks(difference, mean.level, mean.usable & ~copied)


def _blocks(values: Float32[np.ndarray, "blocks 3 pixels"], level: np.ndarray, usable: np.ndarray) -> NoiseBlocks:
    basis = smooth_basis().astype(np.float32)
    # The mean first and exactly, so that an even block has no residual at all.
    values = values - values.mean(axis=2, keepdims=True, dtype=np.float64).astype(np.float32)
    return NoiseBlocks(level, values - (values @ basis) @ basis.T, usable)


def _cut(rgb: Picture) -> Float32[np.ndarray, "blocks 3 pixels"]:
    """Blocks side by side, evenly left out where there are more than are needed."""
    rows, columns = rgb.shape[0] // BLOCK_PX, rgb.shape[1] // BLOCK_PX
    if not rows or not columns:
        raise InputError(
            f"expected a picture of {BLOCK_PX}x{BLOCK_PX} px or more to measure grain in, got {rgb.shape[1]}x{rgb.shape[0]} px"
        )
    cut = rgb[: rows * BLOCK_PX, : columns * BLOCK_PX].reshape(rows, BLOCK_PX, columns, BLOCK_PX, 3)
    row, column = np.divmod(np.arange(0, rows * columns, -(-rows * columns // _MOST_BLOCKS)), columns)
    return np.ascontiguousarray(cut[row, :, column].transpose(0, 3, 1, 2)).reshape(len(row), 3, BLOCK_PX * BLOCK_PX)


@cache
def smooth_basis() -> Float64[np.ndarray, "pixels 6"]:
    """Orthonormal columns that span the paraboloids over a block: out-of-focus places bend, and bending is not noise."""
    y, x = (each.ravel() for each in np.mgrid[-1.0 : 1.0 : BLOCK_PX * 1j, -1.0 : 1.0 : BLOCK_PX * 1j])
    return np.linalg.qr(np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=1))[0]


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
    level = np.maximum(level, 0.0)
    expected = np.full_like(variance, variance.mean())
    slope = intercept = 0.0
    for _ in range(8):
        weight = 1.0 / np.maximum(expected, 1e-3 * max(float(variance.mean()), 1e-30))
        slope, intercept = least_line(level, variance, weight**2)
        expected = slope * level + intercept
    return slope, intercept


def least_line(
    level: Float64[np.ndarray, " points"], variance: Float64[np.ndarray, " points"], weight: Float64[np.ndarray, " points"]
) -> tuple[float, float]:
    """Return slope and intercept, neither below 0, of the line with the least weighted squares. level, variance: not below 0.

    Where the best line has a slope or an intercept below 0, one of them is 0: that which leaves less.
    """
    steep = weight * level  # summed without BLAS, whose threads wait for one another over so little
    level2, level1, ones = (float(each.sum()) for each in (steep * level, steep, weight))
    product, sum_ = float((steep * variance).sum()), float((weight * variance).sum())
    if (size := level2 * ones - level1 * level1) > 1e-12 * level2 * ones:
        slope, intercept = (product * ones - level1 * sum_) / size, (level2 * sum_ - level1 * product) / size
        if slope >= 0.0 and intercept >= 0.0:
            return slope, intercept
    # What one of them takes off the sum of squares.
    by_slope, even = product**2 / level2 if level2 > 0.0 else 0.0, sum_**2 / ones
    return (product / level2, 0.0) if by_slope > even else (0.0, sum_ / ones)


def _as_noise(lines: list[tuple[float, float]]) -> NoiseLevel:
    slopes, intercepts = zip(*lines, strict=True)
    return NoiseLevel(triple_of(np.array(slopes)), triple_of(np.array(intercepts)))


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
    step = -(-len(blocks.level) // _MOST_CORRELATED_BLOCKS)
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
    """Return the mean products of residuals at each lag (row) for a covariance of 1 at one lag (column).

    With A for the pairs of pixels of a lag and P = B B' these are tr(A' (1 - P) C (1 - P)) over the number of pairs: products of A B,
    A' B and B' A B, which are the basis moved by the lag.
    """
    basis = smooth_basis()
    lags = [(dy, dx) for dy in range(-REACH_PX, REACH_PX + 1) for dx in range(-REACH_PX, REACH_PX + 1)]
    moved = np.stack([_moved(basis, dy, dx) for dy, dx in lags])
    within = (basis.T @ moved).reshape(len(lags), -1)
    moved = moved.reshape(len(lags), -1)
    # The lags are in an order in which the last is the opposite of the first.
    products = within @ within.T - moved @ moved.T - moved[::-1] @ moved[::-1].T
    counts = np.array([(BLOCK_PX - abs(dy)) * (BLOCK_PX - abs(dx)) for dy, dx in lags])
    return np.eye(len(lags)) + products / counts[:, None]


def _moved(basis: Float64[np.ndarray, "pixels terms"], dy: int, dx: int) -> Float64[np.ndarray, "pixels terms"]:
    """Return for each pixel of a block what the basis has (dy, dx) from it, 0 beyond the block."""
    images = basis.reshape(BLOCK_PX, BLOCK_PX, -1)
    wide = np.pad(images, ((REACH_PX, REACH_PX), (REACH_PX, REACH_PX), (0, 0)))
    top, left = REACH_PX + dy, REACH_PX + dx
    return wide[top : top + BLOCK_PX, left : left + BLOCK_PX].reshape(basis.shape)
