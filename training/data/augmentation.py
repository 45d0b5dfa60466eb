"""Depth made worse while training, so that a network does not trust it more than it should.

Training pairs have the depth of many photographs taken for the purpose; the network is later used on a depth of another origin, with
other errors. Strength 1 reproduces the errors of focus and multi-view stereo together on traced stacks with known truth
(docs/measured.md, "Capture"; `python -m tests.bench.bench_capture`): a median relative error of 0.13 to 0.19 %, 2.1 to 6.3 % of the
pixels off by more than 0.05 dioptres, and silhouettes off by about a pixel. Pictures stay as they are; only circles of confusion
change. The errors are smooth random fields, which vary slowly over a picture.
"""

import functools
import math
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
from jaxtyping import Float32

from training.data.pairs import Pair

_SIGMA_IN_CELLS = 0.7  # two cells away little is left, and the grid does not show
Dioptres = Float32[np.ndarray, "height width"]
MEDIAN_RELATIVE_ERROR = 0.0016
_SIGMA_PER_MEDIAN = 1.0 / 0.6745  # of a normal distribution, of its absolute value
MISTAKEN_SHARE, MISTAKEN_BY_DIOPTRES = 0.03, 0.05  # the rest of the 2 to 6 % are pixels beside silhouettes, and depend on the scene
SILHOUETTE_PX = 0.9  # standard deviation along each axis, by which edges are pushed
_GROWN_SHARE = 0.5  # of the picture, where near things are also a pixel larger or smaller
_LARGEST_SHARE = 0.5
_ERROR_CELL_PX, _REGION_CELL_PX, _EDGE_CELL_PX = 64.0, 16.0, 12.0


def augmented(pair: Pair, depth_noise: float, rng: np.random.Generator, largest_coc_px: float = math.inf) -> Pair:
    """Return the pair with worse circles of confusion. depth_noise: strength, 0 returns the pair itself.

    largest_coc_px: the limit of the network; no diameter becomes larger.
    """
    if depth_noise == 0.0:
        return pair
    true = pair.dioptres
    worse = _Noise(depth_noise, rng).on(true)
    change_px = (worse - true) * np.float32(pair.coc_px_per_dioptre)
    return replace(pair, coc_px=np.clip(pair.coc_px - change_px, -largest_coc_px, largest_coc_px).astype(np.float32))


@dataclass(frozen=True)
class _Noise:
    """Errors of depth at one strength."""

    strength: float
    rng: np.random.Generator

    def on(self, dioptres: Dioptres) -> Dioptres:
        """Apply all errors; nothing is moved beyond infinity that was not there."""
        shape = self._pushed(self._grown(dioptres))
        return np.maximum(shape + self._smooth_error(shape) + self._mistakes(shape), np.minimum(dioptres, 0.0))

    def _grown(self, dioptres: Dioptres) -> Dioptres:
        """Enlarge silhouettes of near things in some regions (dilation) and shrink them in others (erosion)."""
        import cv2

        radius = math.ceil(self.strength)
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * radius + 1, 2 * radius + 1))
        field, limit = self._field(dioptres, _EDGE_CELL_PX), _deviations(0.5 * _GROWN_SHARE * self.strength / radius)
        grown = np.where(field > limit, cv2.dilate(dioptres, kernel), dioptres)
        return np.where(field < -limit, cv2.erode(dioptres, kernel), grown)

    def _pushed(self, dioptres: Dioptres) -> Dioptres:
        """Displace elastically: each pixel takes the depth of one nearby, never one between two, so that edges in depth stay sharp."""
        import cv2

        rows, columns = np.indices(dioptres.shape, np.float32)
        down, across = (SILHOUETTE_PX * self.strength * self._field(dioptres, _EDGE_CELL_PX) for _ in range(2))
        pushed = cv2.remap(dioptres, columns + across, rows + down, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(pushed, np.float32)

    def _smooth_error(self, dioptres: Dioptres) -> Dioptres:
        sigma = self.strength * MEDIAN_RELATIVE_ERROR * _SIGMA_PER_MEDIAN
        return np.float32(sigma) * dioptres * octaves(_size(dioptres), _ERROR_CELL_PX, 3, self.rng)

    def _mistakes(self, dioptres: Dioptres) -> Dioptres:
        """Shift regions as if another depth had matched: by 0.06 to some 0.15 dioptres, nearer or farther."""
        field, limit = self._field(dioptres, _REGION_CELL_PX), _deviations(min(MISTAKEN_SHARE * self.strength, _LARGEST_SHARE))
        size = MISTAKEN_BY_DIOPTRES * (1.2 + 2.0 * np.maximum(field - limit, 0.0))
        side = np.sign(self._field(dioptres, _ERROR_CELL_PX))
        return np.where(field > limit, side * size, 0.0).astype(np.float32)

    def _field(self, dioptres: Dioptres, cell_px: float) -> Dioptres:
        return smooth_noise(_size(dioptres), cell_px, self.rng)


def _size(dioptres: Dioptres) -> tuple[int, int]:
    return dioptres.shape[0], dioptres.shape[1]


def _deviations(share: float) -> float:
    """Return how many standard deviations a normal variable exceeds in this fraction of cases."""
    return NormalDist().inv_cdf(1.0 - share)


def smooth_noise(size_px: tuple[int, int], cell_px: float, rng: np.random.Generator) -> Float32[np.ndarray, "height width"]:
    """Return (height, width) normal noise with mean 0 and variance 1 at every pixel; values a cell apart are nearly independent.

    White noise on a grid, spread by Gaussians; each row of weights has a sum of squares of 1, so that the variance is exact.
    """
    down, across = (_weights(length, cell_px) for length in size_px)
    grid = rng.standard_normal((down.shape[1], across.shape[1]), dtype=np.float32)
    return np.asarray(down @ grid @ across.T)


def octaves(size_px: tuple[int, int], cell_px: float, count: int, rng: np.random.Generator) -> Float32[np.ndarray, "height width"]:
    """Sum octaves of noise as Perlin does: each with half the cell and half the amplitude of the last; mean 0, variance 1."""
    amplitudes = 0.5 ** np.arange(count)
    fields = [amplitude * smooth_noise(size_px, cell_px * amplitude, rng) for amplitude in amplitudes.tolist()]
    return np.asarray(sum(fields) / np.float32(np.linalg.norm(amplitudes)), np.float32)


@functools.lru_cache(maxsize=64)
def _weights(length_px: int, cell_px: float) -> Float32[np.ndarray, "pixels nodes"]:
    nodes = np.arange(-2, int(np.ceil(length_px / cell_px)) + 3) * cell_px
    offsets = (np.arange(length_px) + 0.5)[:, None] - nodes
    weights = np.exp(-0.5 * (offsets / (_SIGMA_IN_CELLS * cell_px)) ** 2)
    return np.asarray(weights / np.linalg.norm(weights, axis=1, keepdims=True), np.float32)
