"""The published network with its wide kernels by Fourier transforms: an experiment, to see what a GPU could gain.

A direct convolution of width k takes k * k products for each pixel, a transform takes the same whatever the width. Spectra of kernels are
made once for a size of picture; they take the memory of two spectra of the picture for each block.
"""

import scipy.fft
import torch
from torch import Tensor, nn
from torch.nn import functional

from training.networks.network import BlurNetwork
from training.networks.published_network import PublishedTiles, ResidualBlock

LEAST_SIZE = 9
"""Narrower kernels are convolved as they are."""


class FourierConvolution:
    """A depthwise convolution of a picture that has been padded already, by transforms; of one size of picture."""

    def __init__(self, convolution: nn.Conv2d, height: int, width: int) -> None:
        assert convolution.bias is not None
        self.bias, self.height, self.width = convolution.bias[:, None, None], height, width
        beyond = convolution.kernel_size[0] - 1
        self.lengths = [scipy.fft.next_fast_len(length + beyond, real=True) for length in (height, width)]
        self.spectrum = torch.fft.rfft2(convolution.weight[:, 0], s=self.lengths).conj().resolve_conj()

    def __call__(self, padded: Tensor) -> Tensor:
        whole = torch.fft.irfft2(torch.fft.rfft2(padded, s=self.lengths) * self.spectrum, s=self.lengths)
        return whole[..., : self.height, : self.width] + self.bias


class FourierBlock:
    """`ResidualBlock` with both convolutions by transforms, where these are wide."""

    def __init__(self, block: ResidualBlock, height: int, width: int) -> None:
        self.block = block
        is_wide = 2 * block.radius + 1 >= LEAST_SIZE
        self.convolutions = [FourierConvolution(each, height, width) for each in (block.first, block.second)] if is_wide else []

    def __call__(self, x: Tensor) -> Tensor:
        if not self.convolutions:
            result: Tensor = self.block(x)
            return result
        first, second = self.convolutions
        inner = torch.relu(first(self._padded(x)))
        return torch.relu(x + second(self._padded(inner)))

    def _padded(self, x: Tensor) -> Tensor:
        return functional.pad(x, (self.block.radius,) * 4, mode="replicate")


class FourierNetwork:
    """`BlurNetwork` of the published form in one tile, in float32, for pictures of one size; called as that is."""

    def __init__(self, network: BlurNetwork, height: int, width: int) -> None:
        assert isinstance(network.tiles, PublishedTiles) and network.grid is None
        self.network, self.tiles = network, network.tiles
        blocks = [each for each in self.tiles.blocks if isinstance(each, ResidualBlock)]
        self.blocks = [FourierBlock(each, height, width) for each in blocks]

    def __call__(self, rgb: Tensor, coc_px: Tensor) -> Tensor:
        x = self.network.encode(rgb, coc_px)
        state = self.tiles.c1(x)
        for block in self.blocks:
            state = block(state)
        y = self.tiles.c2(torch.cat([state, x[:, :3]], dim=1))
        return (torch.tanh(y) + 1.0) * (0.5 * self.network.top)
