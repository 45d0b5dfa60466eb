"""Random batches of crops from training pairs, as tensors. Crops are drawn before any picture is opened: their rows can be read ahead.

Depth is made worse while training, so that a network does not trust it more than it should: training pairs have the depth of many
photographs taken for the purpose; the network is later used on a depth of another origin, with other errors. Strength 1 reproduces the
errors of focus and multi-view stereo together on traced stacks with known truth (docs/measured.md, "Capture";
`python -m tests.bench.bench_capture`): a median relative error of 0.13 to 0.19 %, 2.1 to 6.3 % of the pixels off by more than 0.05
dioptres, and silhouettes off by about a pixel. Pictures stay as they are; only circles of confusion change. The errors are smooth random
fields, which vary slowly over a picture.
"""

import copy
import functools
import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from training.data.dataset import PairSet, Window
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


_DRAWN_AHEAD = 8


@dataclass(frozen=True)
class Crop:
    """One crop. window: the rows that must be read; rows, columns: in the picture; their weights: 0 where light is missing.

    noise_seed: of everything random inside the crop.
    """

    window: Window
    rows: slice
    columns: slice
    row_weight: Float32[np.ndarray, " rows"]
    column_weight: Float32[np.ndarray, " columns"]
    noise_seed: int = 0


@dataclass(frozen=True)
class Drawing:
    """Settings of drawing crops.

    crop_px: side, 0 for whole pictures. halo_px: pixels this close to a side of a crop that is not a border of the picture get no
    weight, since their light comes partly from outside the crop. crops_per_picture: that many share a picture and its rows.
    noisy: each crop gets a seed of its own.
    """

    pairs: PairSet
    size: int
    crop_px: int
    halo_px: int
    crops_per_picture: int = 1
    noisy: bool = False

    def draw(self, rng: np.random.Generator) -> list[Crop]:
        """Draw `size` crops, independently of the pictures' content. Two draws equal one of twice the size."""
        crops: list[Crop] = []
        while len(crops) < self.size:
            crops += self._of_one_picture(rng)
        return crops[: self.size]

    def draw_share(self, rng: np.random.Generator, number: int = 0, count: int = 1) -> list[Crop]:
        """Return the part of process `number` of `count` in a common draw; all processes have rng in the same state, before and after."""
        return [self.draw(rng) for _ in range(count)][number]

    def next_windows(self, rng: np.random.Generator, number: int = 0, count: int = 1) -> Iterator[Window]:
        """Yield the windows that the next calls of `draw_share` will need; rng itself is not advanced."""
        coming = copy.deepcopy(rng)
        for _ in range(max(1, _DRAWN_AHEAD // self.size)):
            yield from (crop.window for crop in self.draw_share(coming, number, count))

    def _of_one_picture(self, rng: np.random.Generator) -> Iterator[Crop]:
        picture = int(rng.integers(len(self.pairs), size=1)[0])
        height, width = self.pairs.size_px(picture)
        rows, row_weight = self._interval(height, rng)
        window = self.pairs.window(picture, rows)
        for _ in range(self.crops_per_picture):
            columns, column_weight = self._interval(width, rng)
            yield Crop(
                window=window,
                rows=rows,
                columns=columns,
                row_weight=row_weight,
                column_weight=column_weight,
                noise_seed=int(rng.integers(2**63)) if self.noisy else 0,
            )

    def _interval(self, length_px: int, rng: np.random.Generator) -> tuple[slice, Float32[np.ndarray, " length"]]:
        """Return a random interval along one side and the weight of its pixels.

        Starts are drawn from beyond both borders and clamped, so that borders are seen as often as the rest.
        """
        crop_px = min(self.crop_px or length_px, length_px)
        start = 0
        if self.crop_px:
            start = int(np.clip(rng.integers(-self.halo_px, length_px - crop_px + self.halo_px + 1), 0, length_px - crop_px))
        weight = np.ones(crop_px, np.float32)
        if start > 0:
            weight[: self.halo_px] = 0.0
        if start + crop_px < length_px:
            weight[crop_px - self.halo_px :] = 0.0
        return slice(start, start + crop_px), weight


@dataclass(frozen=True)
class Batch:
    """Pairs as tensors.

    rgb, target: (B, 3, h, w) linear radiance. coc_px: (B, 1, h, w) signed diameters. weight: (B, 1, h, w).
    place: (B, 2, h, w) field positions in the whole frame. lens: (B, 2) f-number and focal length in mm.
    saturated: (B, 1, h, w) where the target is only a lower bound; None: nowhere.
    """

    rgb: Tensor
    coc_px: Tensor
    target: Tensor
    weight: Tensor
    place: Tensor
    lens: Tensor
    saturated: Tensor | None = None

    def to(self, device: torch.device) -> "Batch":
        return Batch(**{name: part.to(device) for name, part in self.parts().items()})

    def parts(self) -> dict[str, Tensor]:
        """Return all tensors that are present, by name."""
        return {name: part for name, part in vars(self).items() if part is not None}


def draw_batch(
    pairs: PairSet,
    size: int,
    crop_px: int,
    halo_px: int,
    rng: np.random.Generator,
    *,
    depth_noise: float = 0.0,
    largest_coc_px: float = float("inf"),
) -> Batch:
    """Draw pairs and crop positions at random and join them in one batch; see `draw_share`."""
    drawing = Drawing(pairs, size, crop_px, halo_px, noisy=depth_noise > 0.0)
    return _joined(list(draw_share(drawing, rng, depth_noise=depth_noise, largest_coc_px=largest_coc_px)))


def draw_share(
    drawing: Drawing,
    rng: np.random.Generator,
    number: int = 0,
    count: int = 1,
    *,
    depth_noise: float = 0.0,
    largest_coc_px: float = float("inf"),
    device: torch.device | None = None,
    kept: dict[int, Batch] | None = None,
) -> Iterator[Batch]:
    """Yield the pictures of a step, one by one, for process `number` of `count`: `drawing.size` for each process, from one sequence.

    rng is advanced when this returns. While the caller computes, the pictures of the next calls are read in the background, provided
    that they draw alike with this rng; otherwise they only wait longer.
    depth_noise: how badly depth is made worse (`training.data.batches`; the drawing must be noisy), up to diameters of largest_coc_px.
    kept: of whole pictures, which stay on the device once they are there.
    """

    def batch_of(crop: Crop) -> Batch:
        if kept is not None and crop.window.index in kept:
            return kept[crop.window.index]
        batch = _single(_pair(drawing.pairs, crop, depth_noise, largest_coc_px))
        batch = batch if device is None else batch.to(device)
        if kept is not None:
            kept[crop.window.index] = batch
        return batch

    crops = drawing.draw_share(rng, number, count)
    drawing.pairs.expect(itertools.chain((crop.window for crop in crops), drawing.next_windows(rng, number, count)))
    return (batch_of(crop) for crop in crops)


def stack_pairs(pairs: Sequence[Pair]) -> Batch:
    """Copy pairs of one size, whole or cropped, into one batch."""
    return _joined([_single(pair) for pair in pairs])


def network_inputs(pair: Pair) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return rgb, coc_px, place and lens of a pair as tensors with B = 1."""
    return (
        _channel_first(pair.all_in_focus),
        torch.from_numpy(pair.coc_px.copy())[None, None],
        _channel_first(pair.place),
        torch.tensor([[pair.f_number, pair.focal_length_mm]], dtype=torch.float32),
    )


def _pair(pairs: PairSet, crop: Crop, depth_noise: float, largest_coc_px: float) -> Pair:
    pair = pairs.cut(crop.window, crop.rows, crop.columns)
    pair = pair.weighted(crop.row_weight[:, None] * crop.column_weight)
    return pair if depth_noise == 0.0 else augmented(pair, depth_noise, np.random.default_rng(crop.noise_seed), largest_coc_px)


def _single(pair: Pair) -> Batch:
    rgb, coc_px, place, lens = network_inputs(pair)
    saturated = None if pair.saturated is None else torch.from_numpy(pair.saturated.copy())[None, None]
    return Batch(
        rgb=rgb,
        coc_px=coc_px,
        target=_channel_first(pair.target),
        weight=torch.from_numpy(pair.weight.copy())[None, None],
        place=place,
        lens=lens,
        saturated=saturated,
    )


def joined_by_size(batches: Iterable[Batch]) -> Iterator[Batch]:
    """Yield neighbours of one size as one batch."""
    for _, same in itertools.groupby(batches, key=lambda each: (each.rgb.shape, each.saturated is None)):
        yield _joined(list(same))


def _joined(batches: Sequence[Batch]) -> Batch:
    if len(batches) == 1:
        return batches[0]
    return Batch(**{name: torch.cat([each.parts()[name] for each in batches]) for name in batches[0].parts()})


def _channel_first(picture: np.ndarray) -> Tensor:
    """Copy to (1, C, h, w) with the channels of a pixel side by side in memory, which is fast for convolutions on the CPU."""
    return torch.from_numpy(np.stack([picture.transpose(2, 0, 1)]))
