"""Random batches of crops from training pairs, as tensors."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from training.dataset import Pair, PairSet


@dataclass(frozen=True)
class Batch:
    """rgb, target (B, 3, h, w) linear radiance; coc_px (B, 1, h, w) signed diameters; weight (B, 1, h, w)."""

    rgb: Tensor
    coc_px: Tensor
    target: Tensor
    weight: Tensor

    def to(self, device: torch.device) -> "Batch":
        return Batch(*(each.to(device) for each in (self.rgb, self.coc_px, self.target, self.weight)))


def draw_batch(pairs: PairSet, size: int, crop_px: int, halo_px: int, rng: np.random.Generator) -> Batch:
    """Pairs and crop positions drawn at random; crop_px 0 takes whole pictures.

    halo_px: pixels this close to a side of a crop that is not a border of the picture get no weight, for their light comes
    partly from outside the crop.
    """
    drawn = [pairs[int(index)] for index in rng.integers(len(pairs), size=size)]
    return stack_pairs([_cropped(pair, crop_px, halo_px, rng) if crop_px else pair for pair in drawn])


def stack_pairs(pairs: list[Pair]) -> Batch:
    def colour(name: str) -> Tensor:
        return torch.from_numpy(np.stack([getattr(pair, name).transpose(2, 0, 1) for pair in pairs]))

    def plane(name: str) -> Tensor:
        return torch.from_numpy(np.stack([getattr(pair, name)[None] for pair in pairs]))

    return Batch(colour("all_in_focus"), plane("coc_px"), colour("target"), plane("weight"))


def _cropped(pair: Pair, crop_px: int, halo_px: int, rng: np.random.Generator) -> Pair:
    height, width = pair.coc_px.shape
    rows, row_weight = _interval(height, crop_px, halo_px, rng)
    columns, column_weight = _interval(width, crop_px, halo_px, rng)
    weight = pair.weight[rows, columns] * row_weight[:, None] * column_weight
    return Pair(pair.all_in_focus[rows, columns], pair.coc_px[rows, columns], pair.target[rows, columns], weight)


def _interval(length_px: int, crop_px: int, halo_px: int, rng: np.random.Generator) -> tuple[slice, np.ndarray]:
    """A random interval along one side and the weight of its pixels.

    Starts are drawn from beyond both borders and clamped, so that borders are seen as often as the rest.
    """
    crop_px = min(crop_px, length_px)
    start = int(np.clip(rng.integers(-halo_px, length_px - crop_px + halo_px + 1), 0, length_px - crop_px))
    weight = np.ones(crop_px, np.float32)
    if start > 0:
        weight[:halo_px] = 0.0
    if start + crop_px < length_px:
        weight[crop_px - halo_px :] = 0.0
    return slice(start, start + crop_px), weight
