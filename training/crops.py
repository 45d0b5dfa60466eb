"""Which crops of which pictures come next: drawn before any picture is opened, so that they can be read ahead."""

import copy
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from training.dataset import PairSet
from training.read_ahead import Window

_DRAWN_AHEAD = 8


@dataclass(frozen=True)
class Crop:
    """Where to cut. window: what must be read for it; rows, columns: in the picture; their weights: 0 where light is missing.

    noise_seed: of what is random inside the crop.
    """

    window: Window
    rows: slice
    columns: slice
    row_weight: Float32[np.ndarray, " rows"]
    column_weight: Float32[np.ndarray, " columns"]
    noise_seed: int = 0


@dataclass(frozen=True)
class Drawing:
    """How crops are drawn.

    crop_px: side, 0 for whole pictures. halo_px: pixels this close to a side of a crop that is not a border of the picture get no
    weight, for their light comes partly from outside the crop. crops_per_picture: so many share a picture and its rows.
    noisy: each crop gets a seed of its own.
    """

    pairs: PairSet
    size: int
    crop_px: int
    halo_px: int
    crops_per_picture: int = 1
    noisy: bool = False

    def draw(self, rng: np.random.Generator) -> list[Crop]:
        """`size` crops; takes from rng the same numbers whatever the pictures show. Two draws are one of twice the size."""
        crops: list[Crop] = []
        while len(crops) < self.size:
            crops += self._of_one_picture(rng)
        return crops[: self.size]

    def draw_share(self, rng: np.random.Generator, number: int = 0, count: int = 1) -> list[Crop]:
        """What process `number` of `count` takes of a draw for all; each of them has rng in the same state, before and after."""
        return [self.draw(rng) for _ in range(count)][number]

    def next_windows(self, rng: np.random.Generator, number: int = 0, count: int = 1) -> Iterator[Window]:
        """What the next calls of `draw_share` will need; rng itself stays as it is."""
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
            yield Crop(window, rows, columns, row_weight, column_weight, int(rng.integers(2**63)) if self.noisy else 0)

    def _interval(self, length_px: int, rng: np.random.Generator) -> tuple[slice, Float32[np.ndarray, " length"]]:
        """A random interval along one side and the weight of its pixels.

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
