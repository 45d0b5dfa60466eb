"""Random batches of crops from training pairs, as tensors.

Crops are drawn before any picture is opened, so that their rows can be read ahead.
"""

import copy
import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from training.data.augmentation import augmented
from training.data.dataset import Pair, PairSet, Window

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
) -> Iterator[Batch]:
    """Yield the pictures of a step, one by one, for process `number` of `count`: `drawing.size` for each process, from one sequence.

    rng is advanced when this returns. While the caller computes, the pictures of the next calls are read in the background, provided
    that they draw alike with this rng; otherwise they only wait longer.
    depth_noise: how badly depth is made worse (`training.data.augmentation`; the drawing must be noisy), up to diameters of largest_coc_px.
    """
    crops = drawing.draw_share(rng, number, count)
    drawing.pairs.expect(itertools.chain((crop.window for crop in crops), drawing.next_windows(rng, number, count)))
    return (_single(_pair(drawing.pairs, crop, depth_noise, largest_coc_px)) for crop in crops)


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


def _joined(batches: Sequence[Batch]) -> Batch:
    if len(batches) == 1:
        return batches[0]
    return Batch(**{name: torch.cat([each.parts()[name] for each in batches]) for name in batches[0].parts()})


def _channel_first(picture: np.ndarray) -> Tensor:
    """Copy to (1, C, h, w) with the channels of a pixel side by side in memory, which is fast for convolutions on the CPU."""
    return torch.from_numpy(np.stack([picture.transpose(2, 0, 1)]))
