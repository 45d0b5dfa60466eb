"""How place and lens choose between the kernels of a bin."""

import torch
from torch import Tensor, nn


class FieldMixing(nn.Module):
    """For every pixel and bin, shares of its light that sum to 1, one for each of the bin's kernels.

    A pointwise network of place and lens, then a softmax. It does not see the picture, so what it mixes stays linear in radiance.
    """

    def __init__(self, inputs: int, hidden: int, bins: int, bases: int, tiles: int) -> None:
        super().__init__()
        self.inputs, self.hidden, self.bases, self.tile_count = inputs, hidden, bases, tiles
        self.enter = nn.Conv2d(inputs * tiles, hidden * tiles, 1, groups=tiles)
        self.weight = nn.Parameter(torch.zeros(tiles, bins, bases, hidden))
        self.bias = nn.Parameter(torch.zeros(tiles, bins, bases))

    def features(self, where: Tensor) -> Tensor:
        """(B, tiles, inputs, h, w) in [-1, 1] to (B, tiles * hidden, h, w)."""
        batch, _, _, height, width = where.shape
        return torch.tanh(self.enter(where.reshape(batch, -1, height, width)))

    def shares(self, features: Tensor, bins: list[int]) -> Tensor:
        """(B, tiles, these bins, bases, h, w)."""
        batch, _, height, width = features.shape
        weight, bias = self.weight[:, bins].reshape(-1, self.hidden, 1, 1), self.bias[:, bins].reshape(-1)
        logits = nn.functional.conv2d(features, weight, bias, groups=self.tile_count)
        return logits.reshape(batch, self.tile_count, len(bins), self.bases, height, width).softmax(dim=3)
