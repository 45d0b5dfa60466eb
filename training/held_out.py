"""How far a network has come, on a few slices of stacks that are held out; they are read when asked for, not kept."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from mrbokeh.images.image_io import SheetRow
from mrbokeh.stacks.focal_stack import FocalStack
from training.batches import Batch, stack_pairs
from training.dataset import Pair, PairSet
from training.sheets import small_picture
from training.stacks import ChosenSlices
from training.weights import WHERE_TRUTH_IS_KNOWN

SLICES = 4
SIDE_PX = 384
"""Side of the middle of a picture that a look is at: with blur of 66 px a network took 20 s for a whole picture of 0.8 megapixels."""


@dataclass(frozen=True)
class Look:
    """psnr_db: mean over slices, of linear radiance clipped to [0, 1] where the truth is known; nan where nothing is held out.

    rows: for a sheet: the sharp picture, what the network makes of it, and the photograph.
    """

    psnr_db: float
    rows: tuple[SheetRow, ...] = ()


class HeldOutSlices:
    """Some slices, spread over stacks and focus range: the middle of each, or all of it where tiles have their own places."""

    def __init__(self, stacks: Sequence[FocalStack], slices: ChosenSlices | None = None) -> None:
        self._pairs = PairSet(stacks, WHERE_TRUTH_IS_KNOWN, cache_mib=0, slices=slices)
        spread = np.linspace(0, len(self._pairs) - 1, SLICES if len(self._pairs) else 0)
        self._chosen = [int(index) for index in np.unique(spread.round())]

    def __len__(self) -> int:
        return len(self._chosen)

    @torch.no_grad()
    def look(self, network: torch.nn.Module, device: torch.device) -> Look:
        """Score and show the slices in full precision, whatever the training's."""
        scored = [self._scored(index, network, device) for index in self._chosen]
        return Look(float(np.mean([value for value, _ in scored])) if scored else math.nan, tuple(row for _, row in scored))

    def _scored(self, index: int, network: torch.nn.Module, device: torch.device) -> tuple[float, SheetRow]:
        tiled = getattr(network, "grid", None) is not None
        batch = stack_pairs([self._pairs[index] if tiled else _middle(self._pairs[index])]).to(device)
        result = network(batch.rgb, batch.coc_px, batch.place, batch.lens)
        psnr_db = _psnr_db(result, batch)
        pictures = {"sharp": batch.rgb, f"network {psnr_db:.2f} dB": result, "photograph": batch.target}
        small = {caption: small_picture(picture[0].permute(1, 2, 0).cpu().numpy()) for caption, picture in pictures.items()}
        return psnr_db, SheetRow(self._pairs.label(index), small)


def _middle(pair: Pair) -> Pair:
    """At most SIDE_PX wide and high; what gets light from outside has no weight."""
    halo_px = math.ceil(float(np.abs(pair.coc_px).max()) / 2.0)
    parts, weights = [], []
    for length in pair.coc_px.shape:
        side = min(length, max(SIDE_PX, 4 * halo_px))
        start = (length - side) // 2
        weight = np.ones(side, np.float32)
        if side < length:
            weight[:halo_px] = weight[side - halo_px :] = 0.0
        parts.append(slice(start, start + side))
        weights.append(weight)
    return pair.cut(parts[0], parts[1]).weighted(weights[0][:, None] * weights[1])


def _psnr_db(result: torch.Tensor, batch: Batch) -> float:
    error = result.clamp(0, 1) - batch.target.clamp(0, 1)
    weight = batch.weight.expand_as(error)
    mean = float((weight * error.square()).sum() / weight.sum().clamp(min=1e-6))
    return -10.0 * math.log10(max(mean, 1e-12))
