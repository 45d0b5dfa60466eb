"""What a trained gated network consists of, bin by bin in ascending order of signed diameter, as arrays that can be changed."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import nn

from training.gated_network import GatedTiles

CHANNELS = 16  # ONNX Runtime convolves channel by channel in blocks of so many


@dataclass(frozen=True)
class GatedWeights:
    """knots_px: (bins,), signed diameters at which gates peak. kernels: for each bin (bases, colours, k, k), every kernel with sum 1.

    Pointwise, in words of training/gated_network.py: of_gates and of_coverages (bins, hidden) with hidden_bias (hidden,) give the hidden
    features, logits (bins, hidden) and logits_bias (bins,) what a bin counts. shares (bins, bases, features) and shares_bias (bins,
    bases) choose between bases; they are empty where there is one.
    """

    knots_px: np.ndarray
    kernels: tuple[np.ndarray, ...]
    of_gates: np.ndarray
    of_coverages: np.ndarray
    hidden_bias: np.ndarray
    logits: np.ndarray
    logits_bias: np.ndarray
    shares: np.ndarray
    shares_bias: np.ndarray

    @property
    def bases(self) -> int:
        return int(self.kernels[0].shape[0])

    @property
    def colours(self) -> int:
        return int(self.kernels[0].shape[1])

    @property
    def maps(self) -> int:
        """Maps of a bin with one base: the light, and the coverage of each kernel."""
        return 3 + self.colours

    @property
    def bins_at_once(self) -> int:
        """The fewest bins that fill blocks of channels without a rest."""
        return CHANNELS // math.gcd(CHANNELS, self.maps * self.bases)

    @property
    def radii_px(self) -> list[int]:
        return [kernel.shape[-1] // 2 for kernel in self.kernels]


def weights_of(tiles: GatedTiles) -> GatedWeights:
    """Read the weights of a network without tiles."""
    order = np.argsort(tiles.knots)
    kernels = [kernel for n in range(1, len(tiles.kernels) + 1) for kernel in _kernels(tiles, n)]
    hidden, hidden_bias = pointwise(tiles.hide_in)
    logits, logits_bias = pointwise(tiles.hide_out)
    mixing, none = tiles.mixing, np.zeros((len(order), 1, 0), np.float32)
    return GatedWeights(
        np.asarray(tiles.knots)[order],
        tuple(kernels[each] for each in order),
        hidden[:, : len(order)].T[order],
        hidden[:, len(order) :].T[order],
        hidden_bias,
        logits[order],
        logits_bias[order],
        none if mixing is None else mixing.weight.detach()[0].numpy()[order],
        none[:, 0] if mixing is None else mixing.bias.detach()[0].numpy()[order],
    )


def pointwise(convolution: nn.Conv2d) -> tuple[np.ndarray, np.ndarray]:
    """(outputs, inputs) and (outputs,)."""
    assert convolution.bias is not None
    return convolution.weight.detach()[:, :, 0, 0].numpy(), convolution.bias.detach().numpy()


def _kernels(tiles: GatedTiles, n: int) -> np.ndarray:
    """(bins of this size, bases, colours, 2n+1, 2n+1)."""
    magnitude = tiles.kernels[n - 1].detach().abs()[0].double()
    kernels = magnitude / magnitude.sum(dim=(-2, -1), keepdim=True)
    return kernels.reshape(-1, tiles.bases, *kernels.shape[1:]).numpy()


def widened(kernels: Float[np.ndarray, "... k k"], size: int) -> Float[np.ndarray, "... size size"]:
    """Put zeros around kernels."""
    margin = (size - kernels.shape[-1]) // 2
    return np.pad(kernels, [(0, 0)] * (kernels.ndim - 2) + [(margin, margin)] * 2)
