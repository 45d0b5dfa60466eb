"""Our gated variant of Neural Bokeh: the same growing per-channel kernels, each serving the pixels whose blur it fits.

The published network must find out by itself, from one input channel, which kernel size belongs to which pixel. Here
the residual blocks stand side by side instead of in a row, and the circle of confusion opens the gate of each:

    gate_n(q)      how much of pixel q belongs to kernel n: a hat function of its circle of confusion, all gates sum to 1
    colour_n       k_n * (gate_n rgb), coverage_n = k_n * gate_n: what bin n spreads to each pixel; k_n >= 0 sums to 1
    weight_n(p)    exp of a pointwise network of gate(p) and coverage(p): who hides whom
    y(p)           sum of weight_n colour_n over sum of weight_n coverage_n

n = 1 serves what is in focus; it starts as a copy, the paper's skip connection, and learns how sharp the camera is. With signed
circles of confusion a lens has kernels of its own in front of the focus and behind it. The weights depend on the circles of
confusion alone, so the result is linear in radiance, as light is: a highlight beyond anything seen in training is blurred like any
other, and alpha like colour.

Blur that varies over the frame, or with the lens's settings, needs no tiles: a bin has several kernels k_nb (`field_bases`), and
colour_n = sum over b of k_nb * (share_nb gate_n rgb). The shares sum to 1 and depend on place and lens at the source q, where the
light comes from, so light is conserved (`FieldMixing`).
"""

import math

import torch
from torch import Tensor, nn

from training.networks.kernels import depthwise, fresh_kernels
from training.networks.network_settings import NetworkSettings

LOGIT_LIMIT = 10.0


def bins_px(blocks: int, per_size: int, signed: bool) -> tuple[list[float], list[int]]:
    """Return (circles of confusion at which the gates peak, n of each one's kernel), by n, near before far.

    Kernel size 2n+1 serves diameters up to 2n-1: the pixel left on each side is for the sensor's own blur (its colour
    filters, the resampling of registration). n = 1 serves 1 px and below (signed: its gate peaks at 0), every other n per_size diameters.
    """
    knots, radii = [0.0 if signed else 1.0], [1]
    for n in range(2, blocks + 1):
        diameters = [2.0 * n - 3.0 + 2.0 * (j + 1) / per_size for j in range(per_size)]
        knots += [-each for each in diameters] + diameters if signed else diameters
        radii += [n] * (len(knots) - len(radii))
    return knots, radii


def blocks_for_gates(largest_coc_px: float) -> int:
    """Return the smallest N whose largest kernel, 2N+1 px, serves this circle of confusion (diameter)."""
    return max(1, math.ceil((abs(largest_coc_px) + 1.0) / 2.0))


def hat_lines(knots: list[float]) -> Tensor:
    """Return (4, bins): slope and offset of each hat's rising line, then of its falling line; the outermost hats stay at 1."""
    ascending = sorted(knots)
    lines = []
    for knot in knots:
        i = ascending.index(knot)
        rise = (0.0, 1.0) if i == 0 else _line_to_one(ascending[i - 1], knot)
        fall = (0.0, 1.0) if i == len(knots) - 1 else _line_to_one(ascending[i + 1], knot)
        lines.append((*rise, *fall))
    return torch.tensor(lines).T.contiguous()


def _line_to_one(zero_at: float, one_at: float) -> tuple[float, float]:
    slope = 1.0 / (one_at - zero_at)
    return slope, -zero_at * slope


class FieldMixing(nn.Module):
    """Shares of each pixel's light in the kernels of a bin, which sum to 1.

    A pointwise network of place and lens, then a softmax. It does not see the picture, so the mixture stays linear in radiance.
    """

    def __init__(self, inputs: int, hidden: int, bins: int, bases: int, tiles: int) -> None:
        super().__init__()
        self.inputs, self.hidden, self.bases, self.tile_count = inputs, hidden, bases, tiles
        self.enter = nn.Conv2d(inputs * tiles, hidden * tiles, 1, groups=tiles)
        self.weight = nn.Parameter(torch.zeros(tiles, bins, bases, hidden))
        self.bias = nn.Parameter(torch.zeros(tiles, bins, bases))

    def features(self, where: Tensor) -> Tensor:
        """Map (B, tiles, inputs, h, w) in [-1, 1] to (B, tiles * hidden, h, w)."""
        batch, _, _, height, width = where.shape
        return torch.tanh(self.enter(where.reshape(batch, -1, height, width)))

    def shares(self, features: Tensor, bins: list[int]) -> Tensor:
        """Return (B, tiles, these bins, bases, h, w)."""
        batch, _, height, width = features.shape
        weight, bias = self.weight[:, bins].reshape(-1, self.hidden, 1, 1), self.bias[:, bins].reshape(-1)
        logits = nn.functional.conv2d(features, weight, bias, groups=self.tile_count)
        return logits.reshape(batch, self.tile_count, len(bins), self.bases, height, width).softmax(dim=3)


class GatedTiles(nn.Module):
    """The gated network for all tiles at once: input (B, C tiles, t, t) in [-1, 1], output (B, 3 tiles, t, t).

    kernels[n - 1]: (tiles, bins of this size * bases, colours, 2n+1, 2n+1), bases fastest.
    """

    hats: Tensor

    def __init__(self, settings: NetworkSettings, blocks: int, largest_coc_px: float, tiles: int) -> None:
        super().__init__()
        self.tile_count, self.signed, self.largest_coc_px = tiles, settings.signed_coc, largest_coc_px
        self.activation, self.colours, self.bases = settings.activation, 3 if settings.kernels_per_colour else 1, settings.field_bases
        self.linear_in_radiance, self.reach_px = settings.activation == "identity", blocks
        self.knots, self.radii = bins_px(blocks, settings.width, settings.signed_coc)
        self.register_buffer("hats", hat_lines(self.knots), persistent=False)
        bins = len(self.knots)
        self.kernels = nn.ParameterList(self._fresh_kernels(n, settings.initialisation) for n in range(1, blocks + 1))
        self.hide_in = nn.Conv2d(2 * bins * tiles, settings.hidden * tiles, 1, groups=tiles)
        self.hide_out = nn.Conv2d(settings.hidden * tiles, bins * tiles, 1, groups=tiles)
        for parameter in self.hide_out.parameters():
            nn.init.zeros_(parameter)
        self.mixing = (
            FieldMixing(inputs=settings.input_channels - 4, hidden=settings.hidden, bins=bins, bases=self.bases, tiles=tiles)
            if self.bases > 1
            else None
        )

    def _fresh_kernels(self, n: int, initialisation: str) -> nn.Parameter:
        knots = [knot for knot, radius in zip(self.knots, self.radii, strict=True) if radius == n]
        kernels = fresh_kernels(n, knots, self.bases, initialisation)
        return nn.Parameter(kernels[None, :, None].repeat(self.tile_count, 1, self.colours, 1, 1))

    def forward(self, x: Tensor) -> Tensor:
        batch, _, height, width = x.shape
        inputs = x.reshape(batch, self.tile_count, -1, height, width)
        rgb, gates = 0.5 * (inputs[:, :, :3] + 1.0), self.gates(inputs[:, :, 3:4])  # black is 0, so that it stays black
        used = self._used_bins(gates)
        spread = self._spread(rgb, gates, inputs[:, :, 4:], used)
        weights = self._weights(gates, spread[:, :, :, 3:].mean(dim=3), used)[:, :, :, None]
        total = (weights * spread).sum(dim=2)
        y = (2.0 * total[:, :, :3] / total[:, :, 3:] - 1.0).reshape(batch, -1, height, width)
        return torch.tanh(y) if self.activation == "tanh" else y

    def _used_bins(self, gates: Tensor) -> list[int]:
        """Return the bins that any pixel belongs to; the others spread nothing and are skipped, except in an exported graph."""
        if torch.compiler.is_exporting():
            return list(range(len(self.knots)))
        return gates.detach().amax(dim=(0, 1, 3, 4)).nonzero()[:, 0].tolist()

    def gates(self, coc: Tensor) -> Tensor:
        """Map (B, tiles, 1, h, w) circles of confusion in [-1, 1] to (B, tiles, bins, h, w): linear hats that sum to 1."""
        position = coc * self.largest_coc_px if self.signed else (coc + 1.0) * (0.5 * self.largest_coc_px)
        rise, rise_0, fall, fall_0 = self.hats[:, None, None, :, None, None]
        return torch.minimum(position * rise + rise_0, position * fall + fall_0).clamp(0.0, 1.0)

    def _spread(self, rgb: Tensor, gates: Tensor, where: Tensor, used: list[int]) -> Tensor:
        """Return what the used bins spread: (B, tiles, used, 3 + colours, h, w), colour and then the coverage of each kernel."""
        light = torch.cat([rgb, torch.ones_like(rgb[:, :, : self.colours])], dim=2)[:, :, None]
        features = None if self.mixing is None else self.mixing.features(where)
        by_size = []
        for n in range(1, len(self.kernels) + 1):
            bins = [each for each in used if self.radii[each] == n]
            if not bins:
                continue
            gated = gates[:, :, bins][:, :, :, None] * light
            if self.mixing is not None and features is not None:
                gated = self.mixing.shares(features, bins)[:, :, :, :, None] * gated[:, :, :, None]
            by_size.append(self._convolved(gated, n, [each - self.radii.index(n) for each in bins]))
        return torch.cat(by_size, dim=2)

    def _convolved(self, gated: Tensor, n: int, members: list[int]) -> Tensor:
        """Convolve the bins of one size with their kernels, light and coverage alike.

        gated: (B, tiles, members, 3 + colours, h, w), with several bases (B, tiles, members, bases, 3 + colours, h, w).
        """
        size = 2 * n + 1
        own = [self.bases * member + base for member in members for base in range(self.bases)]
        magnitude = self.kernels[n - 1][:, own].abs()
        kernels = magnitude / magnitude.sum(dim=(-2, -1), keepdim=True)
        kernels = kernels.repeat(1, 1, 2 if self.colours == 3 else 4, 1, 1).reshape(-1, 1, size, size)
        maps = gated.flatten(1, -3)
        if not torch.compiler.is_exporting():
            maps = maps.contiguous(memory_format=torch.channels_last)
        blurred = depthwise(maps, kernels, padding=n).reshape(gated.shape)
        return blurred if self.mixing is None else blurred.sum(dim=3)

    def _weights(self, gates: Tensor, coverage: Tensor, used: list[int]) -> Tensor:
        """Return (B, tiles, used, h, w): the weight of each used bin at a pixel, from the circles of confusion alone."""
        batch, tiles, bins, height, width = gates.shape
        if len(used) < bins:
            coverage = torch.zeros_like(gates).index_copy(2, torch.tensor(used, device=gates.device), coverage)
        seen = torch.cat([gates, coverage], dim=2).reshape(batch, -1, height, width)
        logits = self.hide_out(torch.relu(self.hide_in(seen))).reshape(batch, tiles, bins, height, width)
        return logits[:, :, used].clamp(-LOGIT_LIMIT, LOGIT_LIMIT).exp()
