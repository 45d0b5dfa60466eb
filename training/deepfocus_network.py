"""DeepFocus (Xiao et al. 2018, "DeepFocus: Learned Image Synthesis for Computational Displays"), which Neural Bokeh compares itself with.

Written from the description alone. From the paper: the picture is interleaved (every 2 x 2 pixels become the channels of one, which
loses nothing and doubles what a convolution sees); a stack of 3x3 convolutions with ELU and residual connections, 20 layers of 128
filters, works there; a skip carries the interleaved input past it; de-interleaving gives the picture back.

Ours, where we know of no statement or chose otherwise:
- 20 layers are a first convolution, 9 residual blocks of two and a last one; `blocks` and `hidden` make other sizes.
- A block is x + conv(ELU(conv(ELU(x)))), and the skip is concatenated before the last convolution, as in Neural Bokeh's Eq. 2.
- The inputs are colour and circle of confusion (and place and lens where asked for), without the depth, which the circle is made of.
- No batch normalisation: pictures come one at a time and differ in brightness, so that the statistics of a step are those of one
  picture and not of the run. Residual branches that start small keep a deep stack trainable in its place.
It learns faster from circles of confusion without a sign (`signed_coc` false).

Shapes are in words, as in training/network.py.
"""

import torch
from torch import Tensor, nn
from torch.nn import functional

from mrbokeh.system.errors import InputError
from training.network_settings import NetworkSettings

PAPER_BLOCKS, PAPER_HIDDEN = 9, 128
INTERLEAVING = 2
START_OF_BRANCH = 0.1  # of PyTorch's weights


class DeepFocusTiles(nn.Module):
    """Input (B, 4 or more, h, w) in [-1, 1]: R, G, B, circle of confusion, then place and lens where asked for; output (B, 3, h, w).

    Any size: an odd one is continued by a row or a column. Raises InputError where tiles is not 1.
    reach_px: how far from a pixel it looks. linear_in_radiance: it is not.
    """

    linear_in_radiance = False

    def __init__(self, settings: NetworkSettings, blocks: int, largest_coc_px: float, tiles: int) -> None:  # noqa: ARG002 (every form has this signature)
        super().__init__()
        if tiles != 1:
            raise InputError(f"expected one tile for the form deepfocus, got {tiles}: set tile_px and overlap_px to 0")
        inputs = 4 + 2 * settings.field_position + 2 * settings.lens_inputs
        interleaved, hidden = inputs * INTERLEAVING**2, settings.hidden
        self.activation = settings.activation
        self.reach_px = INTERLEAVING * (2 * blocks + 2) + INTERLEAVING - 1
        self.first = _Convolution(interleaved, hidden, settings)
        self.blocks = nn.ModuleList(_ResidualBlock(settings) for _ in range(blocks))
        self.last = _Convolution(hidden + interleaved, 3 * INTERLEAVING**2, settings)
        if settings.initialisation != "default":
            self._start_as_identity(hidden)

    def forward(self, x: Tensor) -> Tensor:
        height, width = x.shape[2:]
        cells = interleave(x)
        if not torch.compiler.is_exporting():
            cells = cells.contiguous(memory_format=torch.channels_last)  # what the CPU's convolutions want
        state = self.first(cells)
        for block in self.blocks:
            state = block(state)
        y = functional.pixel_shuffle(self.last(torch.cat([functional.elu(state), cells], dim=1)), INTERLEAVING)
        y = y[:, :, :height, :width]
        return torch.tanh(y) if self.activation == "tanh" else y

    @torch.no_grad()
    def _start_as_identity(self, hidden: int) -> None:
        """The last convolution copies the colours from the skip and adds little of the blocks, whose branches start small."""
        weight, bias, cell = self.last.weight, self.last.bias, INTERLEAVING**2
        weight.mul_(START_OF_BRANCH)
        weight[:, hidden:] = 0.0
        for channel in range(3 * cell):
            weight[channel, hidden + channel, 1, 1] = 1.0
        assert bias is not None
        bias.zero_()


def interleave(x: Tensor) -> Tensor:
    """(B, C, h, w) to (B, 4 C, ceil(h / 2), ceil(w / 2)): the four pixels of a cell as channels, channel by channel, row by row."""
    height, width = x.shape[2:]
    # One line more on each side, of which as many are cut again as are not needed: no branch on the size, so that it stays free in ONNX.
    whole = functional.pad(x, (0, 1, 0, 1), mode="replicate")
    return functional.pixel_unshuffle(whole[:, :, : (height + 1) // 2 * 2, : (width + 1) // 2 * 2], INTERLEAVING)


class _Convolution(nn.Conv2d):
    """3x3 that keeps the size; what lies beyond the border is a setting."""

    def __init__(self, inputs: int, outputs: int, settings: NetworkSettings) -> None:
        super().__init__(inputs, outputs, 3, padding=1, padding_mode=settings.padding)


class _ResidualBlock(nn.Module):
    def __init__(self, settings: NetworkSettings) -> None:
        super().__init__()
        self.inner, self.outer = (_Convolution(settings.hidden, settings.hidden, settings) for _ in range(2))
        if settings.initialisation != "default":
            with torch.no_grad():
                self.outer.weight.mul_(START_OF_BRANCH)

    def forward(self, x: Tensor) -> Tensor:
        return x + self.outer(functional.elu(self.inner(functional.elu(x))))
