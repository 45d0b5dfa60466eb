"""The two networks that Neural Bokeh is compared with. Shapes are in words, as in training/networks/network.py.

DeepFocus (Xiao et al. 2018, "DeepFocus: Learned Image Synthesis for Computational Displays"), written from the description alone. From
the paper: the picture is interleaved (every 2 x 2 pixels become the channels of one, which loses nothing and doubles the reach of a
convolution); a stack of 3x3 convolutions with ELU and residual connections, 20 layers of 128 filters, works there; a skip carries
the interleaved input past it; de-interleaving gives the picture back. Ours, where the paper is silent or we chose otherwise:
- 20 layers are a first convolution, 9 residual blocks of two and a last one; `blocks` and `hidden` make other sizes.
- A block is x + conv(ELU(conv(ELU(x)))), and the skip is concatenated before the last convolution, as in Neural Bokeh's Eq. 2.
- The inputs are colour and circle of confusion (and place and lens if requested), without the depth, from which the circle follows.
- No batch normalisation: pictures come one at a time and differ in brightness, so that the statistics of a step are those of one
  picture and not of the run. Residual branches that start small keep a deep stack trainable instead.
It learns faster from circles of confusion without a sign (`signed_coc` false).

Neural Cameras' blur (Mandl et al. 2021, "Neural Cameras: Learning Camera Characteristics for Coherent Mixed Reality Rendering")
"only learns the parameters of a Gaussian mixture model, which enables fast rendering, but suffers from a coarse approximation"
(Mandl et al. 2024, Section 2.2). From the papers: a network gives the parameters of a mixture of Gaussians, and the mixture blurs.
Ours, where we know no more:
- A pointwise network of the circle of confusion (and place and lens if requested) gives every pixel a mixture of `blocks` Gaussians,
  "a few" in the paper: weights, standard deviations and offsets. It starts near the standard deviation of a disc, a quarter of its
  diameter.
- The mixture gathers: a pixel is a mean of its surroundings under its own mixture. It ignores occlusion.
- Rendering blends pictures blurred once by a few fixed Gaussians, sqrt(2) apart: a Gaussian between two of them is a share of each with
  the right variance; an offset is a share of the same picture shifted by about one standard deviation, with the right mean.
Colours are only blurred, so the result is linear in radiance, and a single highlight keeps all of its light.
"""

import itertools
import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from mrbokeh.system.errors import InputError
from training.networks.network_settings import NetworkSettings

INTERLEAVING = 2
START_OF_BRANCH = 0.1  # of PyTorch's weights
SIGMA_OVER_COC = 0.25
SMALLEST_SIGMA_PX, LARGEST_SIGMA_OVER_COC, SIGMA_RATIO = 0.35, 0.4, math.sqrt(2.0)
TRUNCATED_AT_SIGMA = 3.5
SHARPEST_LOGIT = -6.0  # softplus gives 0.0025 px^2, the blur in focus at the start: as good as none, but it can learn


class DeepFocusTiles(nn.Module):
    """DeepFocus on tiles.

    Input (B, 4 or more, h, w) in [-1, 1]: R, G, B, circle of confusion, then place and lens if requested; output (B, 3, h, w).
    Any size: an odd one is extended by a row or a column. Raises InputError if tiles is not 1.
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
        """Let the last convolution copy the colours from the skip and add little of the blocks, whose branches start small."""
        weight, bias, cell = self.last.weight, self.last.bias, INTERLEAVING**2
        weight.mul_(START_OF_BRANCH)
        weight[:, hidden:] = 0.0
        for channel in range(3 * cell):
            weight[channel, hidden + channel, 1, 1] = 1.0
        assert bias is not None
        bias.zero_()


def interleave(x: Tensor) -> Tensor:
    """Turn (B, C, h, w) into (B, 4 C, ceil(h / 2), ceil(w / 2)): the four pixels of a cell as channels, channel by channel, row by row."""
    height, width = x.shape[2:]
    # One line more on each side, of which as many are cut again as are not needed: no branch on the size, so that it stays free in ONNX.
    whole = functional.pad(x, (0, 1, 0, 1), mode="replicate")
    return functional.pixel_unshuffle(whole[:, :, : (height + 1) // 2 * 2, : (width + 1) // 2 * 2], INTERLEAVING)


class _Convolution(nn.Conv2d):
    """A 3x3 convolution that keeps the size; the padding is a setting."""

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


class NeuralCameraTiles(nn.Module):
    """Neural Cameras' mixture of Gaussians on tiles.

    Input (B, 4 or more, h, w) in [-1, 1]: R, G, B, circle of confusion, then place and lens if requested; output (B, 3, h, w).
    blocks: Gaussians in the mixture. Raises InputError if tiles is not 1. Beyond its border the picture is extended.
    reach_px: how far from a pixel it looks. linear_in_radiance: true without an activation at the end.
    """

    def __init__(self, settings: NetworkSettings, blocks: int, largest_coc_px: float, tiles: int) -> None:
        super().__init__()
        if tiles != 1:
            raise InputError(f"expected one tile for the form neural_camera, got {tiles}: set tile_px and overlap_px to 0")
        self.signed, self.largest_coc_px, self.activation = settings.signed_coc, largest_coc_px, settings.activation
        self.linear_in_radiance = settings.activation == "identity"
        self.gaussians, self.colours = blocks, 3 if settings.kernels_per_colour else 1
        self.bank = GaussianBank(bank_sigmas_px(largest_coc_px))
        self.reach_px = self.bank.reach_px
        inputs = 2 + 2 * settings.field_position + 2 * settings.lens_inputs
        parameters = 5 * self.gaussians * self.colours
        widths = (inputs, settings.hidden, settings.hidden, parameters)
        self.layers = nn.ModuleList(nn.Conv2d(a, b, 1) for a, b in itertools.pairwise(widths))
        self._start_as_discs()

    @torch.no_grad()
    def _start_as_discs(self) -> None:
        """Start with one mixture everywhere, of different Gaussians around that of a disc, so that each can develop on its own."""
        last = self.layers[-1]
        assert isinstance(last, nn.Conv2d) and last.bias is not None
        last.weight.mul_(0.1)
        last.bias.zero_()
        start = last.bias.view(self.colours, self.gaussians, 5)
        if self.gaussians > 1:
            start[:, :, 1] = torch.linspace(-0.3, 0.3, self.gaussians)

    def forward(self, x: Tensor) -> Tensor:
        rgb, coc = 0.5 * (x[:, :3] + 1.0), x[:, 3:4] if self.signed else 0.5 * (x[:, 3:4] + 1.0)
        weight, variance, offset_x, offset_y = self.mixture(coc, x[:, 4:])
        levels = self.bank.shares(variance)
        y = torch.zeros_like(rgb)
        for index, share in enumerate(levels):
            part = weight * share
            taps = (part * each for each in _taps(offset_x, offset_y))
            for picture, tap in zip(self.bank.shifted(rgb, index), taps, strict=True):
                y = y + picture * tap.sum(dim=2)
        y = 2.0 * y - 1.0
        return torch.tanh(y) if self.activation == "tanh" else y

    def mixture(self, coc: Tensor, more: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Return (weights, variances in px^2, offsets x and y in shifts of the bank), each (B, colours, Gaussians, h, w), of every pixel.

        coc (B, 1, h, w) as a fraction of the largest; more: place and lens.
        """
        state = torch.cat([coc, coc.abs(), more], dim=1)
        for layer in self.layers[:-1]:
            state = functional.elu(layer(state))
        batch, _, height, width = coc.shape
        raw = self.layers[-1](state).reshape(batch, self.colours, self.gaussians, 5, height, width)
        sigma_px = (SIGMA_OVER_COC * self.largest_coc_px) * coc.abs()[:, :, None] * (2.0 * torch.tanh(0.5 * raw[:, :, :, 1])).exp()
        variance = sigma_px.square() + functional.softplus(raw[:, :, :, 2] + SHARPEST_LOGIT)
        offsets = 0.5 * torch.tanh(raw[:, :, :, 3:])
        return torch.softmax(raw[:, :, :, 0], dim=2), variance, offsets[:, :, :, 0], offsets[:, :, :, 1]


def _taps(offset_x: Tensor, offset_y: Tensor) -> tuple[Tensor, ...]:
    """Return the shares of the unshifted picture and of those shifted right, left, down and up; their sum is 1, their mean the offset."""
    sides = [functional.relu(each) for each in (offset_x, -offset_x, offset_y, -offset_y)]
    return (1.0 - offset_x.abs() - offset_y.abs(), *sides)


def bank_sigmas_px(largest_coc_px: float) -> list[float]:
    """Return 0 and then standard deviations sqrt(2) apart, up to the widest that a mixture for this circle of confusion may need."""
    largest = max(SMALLEST_SIGMA_PX, LARGEST_SIGMA_OVER_COC * abs(largest_coc_px))
    steps = max(1, math.ceil(math.log(largest / SMALLEST_SIGMA_PX, SIGMA_RATIO)))
    return [0.0] + [SMALLEST_SIGMA_PX * SIGMA_RATIO**step for step in range(steps + 1)]


class GaussianBank(nn.Module):
    """A picture blurred by fixed Gaussians, each also shifted to four sides by about its own standard deviation."""

    variances: Tensor

    def __init__(self, sigmas_px: list[float]) -> None:
        super().__init__()
        self.shifts_px = [max(1, round(sigma)) for sigma in sigmas_px]
        self.radii_px = [math.ceil(TRUNCATED_AT_SIGMA * sigma) for sigma in sigmas_px]
        self.reach_px = max(radius + shift for radius, shift in zip(self.radii_px, self.shifts_px, strict=True))
        kernels = [gaussian_kernel(sigma, radius) for sigma, radius in zip(sigmas_px, self.radii_px, strict=True)]
        for index, kernel in enumerate(kernels):
            self.register_buffer(f"kernel_{index}", kernel, persistent=False)
        variances = torch.stack([_variance(kernel) for kernel in kernels])
        self.register_buffer("variances", variances, persistent=False)

    def shares(self, variance: Tensor) -> list[Tensor]:
        """Return the share of each blurred picture in a Gaussian of this variance (px^2): linear between neighbours, 1 beyond the last."""
        lines = [((variance - low) / (high - low)).clamp(0.0, 1.0) for low, high in zip(self.variances, self.variances[1:], strict=False)]
        below = [torch.ones_like(variance), *lines]
        return [reached - passed for reached, passed in zip(below, [*lines, torch.zeros_like(variance)], strict=True)]

    def shifted(self, rgb: Tensor, index: int) -> tuple[Tensor, ...]:
        """Return (B, 3, h, w) blurred, as seen from each pixel and from `shifts_px` right, left, below and above of it."""
        height, width = rgb.shape[2:]
        shift, radius = self.shifts_px[index], self.radii_px[index]
        wide = functional.pad(rgb, (radius + shift,) * 4, mode="replicate")
        kernel = self.get_buffer(f"kernel_{index}").repeat(3, 1, 1, 1)
        wide = functional.conv2d(functional.conv2d(wide, kernel, groups=3), kernel.transpose(2, 3), groups=3)
        places = ((0, 0), (0, shift), (0, -shift), (shift, 0), (-shift, 0))
        return tuple(wide[:, :, shift + y : shift + y + height, shift + x : shift + x + width] for y, x in places)


def gaussian_kernel(sigma_px: float, radius_px: int) -> Tensor:
    """Return (1, 1, 1, 2 radius + 1), sum 1: a Gaussian at the centres of pixels; a single 1 for sigma 0."""
    if radius_px == 0:
        return torch.ones(1, 1, 1, 1)
    offsets = torch.arange(-radius_px, radius_px + 1, dtype=torch.float64)
    weights = torch.exp(-0.5 * (offsets / sigma_px) ** 2)
    return (weights / weights.sum()).float().reshape(1, 1, 1, -1)


def _variance(kernel: Tensor) -> Tensor:
    """Return the variance of the sampled kernel, which differs from sigma^2 for a narrow one."""
    radius = kernel.shape[-1] // 2
    return (kernel[0, 0, 0] * torch.arange(-radius, radius + 1, dtype=torch.float32).square()).sum()
