"""The Neural Bokeh network (Mandl et al. 2024, Section 3.1 and 3.2).

Our reading of what the paper leaves open:
- "Per-channel convolutions" are depthwise: C1 makes a three-channel tensor per tile, and each of its channels has its own kernels.
- A block is the basic block of He et al. 2016, which the paper cites: R(x) = ReLU(x + conv(ReLU(conv(x)))).
- Every convolution pads its input, so that a block keeps the size of a tile (replicated border unless set otherwise).
- Place and lens, which the paper does not have, enter C1 beside the circle of confusion, if the settings ask for them.
"""

from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional

from training.networks.kernels import depthwise, disc_kernel, pointwise
from training.networks.network_settings import NetworkSettings


class PublishedTiles(nn.Module):
    """The published network for all tiles at once: F(x) = tanh(C2(R_N(... R_1(C1(x)) ...) + x_RGB)) of Eq. 2, "+" being concatenation.

    Input (B, C tiles, t, t), output (B, 3 tiles, t, t). All convolutions are grouped, so no tile sees another.
    channels_last: whether the channels of a pixel lie side by side; None is on a CPU only, where depthwise convolutions are then many times
    faster. Those of a GPU would turn every input round.
    """

    linear_in_radiance = False

    def __init__(self, settings: NetworkSettings, blocks: int, largest_coc_px: float, tiles: int) -> None:  # noqa: ARG002 (every form has this signature)
        super().__init__()
        features, inputs = 3 * settings.width, settings.input_channels
        self.tile_count, self.activation = tiles, settings.activation
        self.channels_last: bool | None = None
        self.c1 = nn.Conv2d(inputs * tiles, features * tiles, 1, groups=tiles)
        radii = [1 if settings.kernels == "3x3" else n for n in range(1, blocks + 1)]
        self.reach_px = 2 * sum(radii)
        self.blocks = nn.ModuleList(ResidualBlock(radius, tiles, settings) for radius in radii)
        self.c2 = nn.Conv2d((features + 3) * tiles, 3 * tiles, 1, groups=tiles)
        if settings.initialisation != "default":
            self._start_as_identity(features)

    def forward(self, x: Tensor) -> Tensor:
        batch, _, height, width = x.shape
        state = pointwise(x.contiguous(memory_format=torch.channels_last) if self._side_by_side(x) else x, self.c1)
        for block in self.blocks:
            state = block(state)
        per_tile = (batch, self.tile_count, -1, height, width)
        joined = torch.cat([state.reshape(per_tile), x.reshape(per_tile)[:, :, :3]], dim=2)
        y = pointwise(joined.reshape(batch, -1, height, width), self.c2)
        return torch.tanh(y) if self.activation == "tanh" else y

    def _side_by_side(self, x: Tensor) -> bool:
        if torch.compiler.is_exporting():
            return False
        return x.device.type == "cpu" if self.channels_last is None else self.channels_last

    @torch.no_grad()
    def _start_as_identity(self, features: int) -> None:
        """Let C1 copy the colours, lifted above the ReLU, and C2 take half of its answer from the blocks and half from the skip."""
        colour = torch.arange(features) % 3
        c1 = self.c1.weight.view(self.tile_count, features, -1)
        c1.mul_(0.1)
        c1[:, torch.arange(features), colour] = 1.0
        _bias(self.c1).fill_(1.0)
        c2 = self.c2.weight.view(self.tile_count, 3, features + 3)
        c2.zero_()
        copies = features // 3
        for channel in range(3):
            c2[:, channel, :features][:, colour == channel] = 0.5 / copies
            c2[:, channel, features + channel] = 0.5
        _bias(self.c2).fill_(-0.5)


class ResidualBlock(nn.Module):
    """The block R_n: two per-channel convolutions of size 2 radius + 1, each followed by a ReLU, the second after the residual sum.

    radius: n as published; 1 in every block of the variant with 3x3 kernels (Table 1, row 2).
    """

    def __init__(self, radius: int, tiles: int, settings: NetworkSettings) -> None:
        super().__init__()
        features, size = 3 * settings.width, 2 * radius + 1
        groups = tiles * (3 if settings.mixing == "colour" else features)
        self.radius, self.padding = radius, settings.padding
        self.first = nn.Conv2d(features * tiles, features * tiles, size, groups=groups)
        self.second = nn.Conv2d(features * tiles, features * tiles, size, groups=groups)
        self.mix = nn.Conv2d(features * tiles, features * tiles, 1, groups=tiles) if settings.mixing == "tile" else nn.Identity()
        self._initialise(settings.initialisation, features, tiles)

    def forward(self, x: Tensor) -> Tensor:
        change = self._convolved(self.second, torch.relu(self._convolved(self.first, x)))
        state = torch.relu(x + change)
        return pointwise(state, self.mix) if isinstance(self.mix, nn.Conv2d) else state

    def _convolved(self, convolution: nn.Conv2d, x: Tensor) -> Tensor:
        padded = self._padded(x)
        if convolution.groups < convolution.in_channels:
            return convolution(padded)  # type: ignore[no-any-return]
        return depthwise(padded, convolution.weight, convolution.bias)

    def _padded(self, x: Tensor) -> Tensor:
        mode: Literal["constant", "replicate", "reflect"] = "constant" if self.padding == "zeros" else self.padding  # type: ignore[assignment]
        return functional.pad(x, (self.radius,) * 4, mode=mode)

    @torch.no_grad()
    def _initialise(self, initialisation: str, features: int, tiles: int) -> None:
        if initialisation == "default":
            return
        if initialisation == "disc":
            self.first.weight.zero_()
            self.first.weight[:, 0] = disc_kernel(2 * self.radius + 1, 2.0 * self.radius + 1.0)
            _bias(self.first).zero_()
        self.second.weight.mul_(0.1)
        _bias(self.second).zero_()
        if isinstance(self.mix, nn.Conv2d):
            self.mix.weight.zero_()
            self.mix.weight.view(tiles, features, features).diagonal(dim1=1, dim2=2).fill_(1.0)
            _bias(self.mix).zero_()


def _bias(convolution: nn.Conv2d) -> Tensor:
    assert convolution.bias is not None
    return convolution.bias
