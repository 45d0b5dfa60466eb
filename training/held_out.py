"""How far a network has come, on a few slices of stacks that are held out; they are read when asked for, not kept."""

import math
from collections.abc import Sequence

import numpy as np
import torch

from mrbokeh.focal_stack import FocalStack
from training.batches import stack_pairs
from training.dataset import PairSet
from training.network import BlurNetwork
from training.weights import WHERE_TRUTH_IS_KNOWN

SLICES = 4


class HeldOutSlices:
    """Some slices, spread over stacks and focus range; whole pictures."""

    def __init__(self, stacks: Sequence[FocalStack]) -> None:
        self._pairs = PairSet(stacks, WHERE_TRUTH_IS_KNOWN, cache_mib=0)
        spread = np.linspace(0, len(self._pairs) - 1, SLICES if len(self._pairs) else 0)
        self._chosen = [int(index) for index in np.unique(spread.round())]

    @torch.no_grad()
    def psnr_db(self, network: BlurNetwork, device: torch.device) -> float:
        """Mean over slices, linear radiance clipped to [0, 1], of the pixels whose truth is known; nan where nothing is held out."""
        values = []
        for index in self._chosen:
            batch = stack_pairs([self._pairs[index]]).to(device)
            error = network(batch.rgb, batch.coc_px).clamp(0, 1) - batch.target.clamp(0, 1)
            weight = batch.weight.expand_as(error)
            mean = float((weight * error.square()).sum() / weight.sum().clamp(min=1e-6))
            values.append(-10.0 * math.log10(max(mean, 1e-12)))
        return float(np.mean(values)) if values else float("nan")
