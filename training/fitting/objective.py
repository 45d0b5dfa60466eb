"""The training objective, and the schedule of the learning rate.

Beside the pixels a loss may compare the light of neighbourhoods and edges. Errors are (B, C, H, W), weights broadcast to them.
"""

import math
from dataclasses import replace
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.nn import functional

from training.data.batches import Batch
from training.fitting.settings import TrainSettings
from training.networks.network import TileGrid, split

_TINY = 1e-6


@runtime_checkable
class Network(Protocol):
    """The interface that the objective needs of a network (`training.networks.network.BlurNetwork`)."""

    grid: TileGrid | None

    def __call__(self, rgb: Tensor, coc_px: Tensor, place: Tensor | None = None, lens: Tensor | None = None) -> Tensor: ...

    def tile_outputs(self, rgb: Tensor, coc_px: Tensor, place: Tensor | None = None, lens: Tensor | None = None) -> Tensor: ...


def loss(network: Network, batch: Batch, radiance_scale: float, largest_coc_px: float, settings: TrainSettings) -> Tensor:
    """Return the loss of one batch: a scalar.

    loss_scope "picture" judges the reassembled picture (Mandl et al. 2024, Section 3.3), "tile" the mean over tiles of each one's own
    part, before overlaps are averaged; a tile counts if any of its pixels does.
    """
    inputs = (batch.rgb, batch.coc_px, batch.place, batch.lens)
    if settings.loss_scope == "picture" or network.grid is None:
        return judged(network(*inputs), batch, radiance_scale, largest_coc_px, settings)
    outputs = network.tile_outputs(*inputs).chunk(len(network.grid), dim=1)
    tiles = _tiles(batch, network.grid)
    losses = [judged(output, tile, radiance_scale, largest_coc_px, settings) for output, tile in zip(outputs, tiles, strict=True)]
    counted = torch.stack([tile.weight.any() for tile in tiles])
    return torch.stack(losses).sum() / counted.sum().clamp(min=1)


def judged(result: Tensor, batch: Batch, radiance_scale: float, largest_coc_px: float, settings: TrainSettings) -> Tensor:
    """Return the mean square error plus the weighted terms for neighbourhoods and edges; 0 for equal pictures."""
    total = mean_square_error(result, batch, radiance_scale, settings)
    if settings.energy_weight == 0.0 and settings.edge_weight == 0.0:
        return total
    error = _error(result, batch, radiance_scale, settings)
    weight = _weight(batch, settings)
    if settings.energy_weight:
        light = local_light_error(error, batch.weight, largest_coc_px)
        total = total + settings.energy_weight * weighted_mean_square(light, weight)
    if settings.edge_weight:
        total = total + settings.edge_weight * gradient_error(error, weight)
    return total


def mean_square_error(result: Tensor, batch: Batch, radiance_scale: float, settings: TrainSettings) -> Tensor:
    """Return Eq. 3 over the reassembled pictures, in the units of the network, [-1, 1]; pixels without weight do not count."""
    return weighted_mean_square(_error(result, batch, radiance_scale, settings), _weight(batch, settings))


def _weight(batch: Batch, settings: TrainSettings) -> Tensor:
    """Return (B, 3, H, W); "relative" turns the error of bright pixels into that of their ratio."""
    weight = batch.weight.expand_as(batch.target)
    if settings.loss_weighting == "relative":
        weight = weight / batch.target.amax(dim=1, keepdim=True).clamp(min=1.0).square()
    return weight


def _error(result: Tensor, batch: Batch, radiance_scale: float, settings: TrainSettings) -> Tensor:
    """Return result less slice, in the units of the network. At a full photosite, a lower bound, a brighter result is no error."""
    result, target = result.float(), batch.target
    if settings.sensor_white is not None:
        result, target = result.clamp(max=settings.sensor_white), target.clamp(max=settings.sensor_white)
    error = (result - target) * (2.0 / radiance_scale)
    return error if batch.saturated is None else torch.where(batch.saturated, error.clamp(max=0.0), error)


def _tiles(batch: Batch, grid: TileGrid) -> list[Batch]:
    """Return the part of a batch that each tile is judged by."""
    planes = {name: split(part, grid).chunk(len(grid), dim=1) for name, part in batch.parts().items() if part.dim() == 4}
    return [replace(batch, **{name: parts[tile] for name, parts in planes.items()}) for tile in range(len(grid))]


def learning_rate_factor(done: float, warm_up: float) -> float:
    """Return the fraction of the peak after this fraction of the budget: a linear rise, then half a cosine to zero."""
    if done < warm_up:
        return max(done / warm_up, 0.02)
    return 0.5 * (1.0 + math.cos(math.pi * min(1.0, (done - warm_up) / (1.0 - warm_up))))


def weighted_mean_square(error: Tensor, weight: Tensor) -> Tensor:
    """Return the mean over pictures of each one's weighted mean, so that together they teach what they teach one by one."""
    over = tuple(range(1, error.dim()))
    return ((weight * error.square()).sum(dim=over) / weight.sum(dim=over).clamp(min=_TINY)).mean()


def local_light_error(error: Tensor, counted: Tensor, largest_coc_px: float) -> Tensor:
    """Return the mean error about each pixel, under a Gaussian as wide as the largest blur, of the pixels that count.

    Blur moves light within a circle of confusion and conserves it. A box instead of the Gaussian would react to a highlight that moved
    by one pixel across its side: with 16 px, twelve times as much as to one that lost a tenth. The standard deviation is half of
    the largest diameter. Next to pixels that do not count it is the mean of the others (normalised convolution, Knutsson and Westin 1993).
    """
    sigma_px = max(0.5 * largest_coc_px, 0.5)
    return gaussian(counted * error, sigma_px) / gaussian(counted, sigma_px).clamp(min=1e-12)


def gradient_error(error: Tensor, weight: Tensor) -> Tensor:
    """Return the mean square difference of the error between neighbours, right and down, where both count: wrong blur of an edge."""
    total = count = error.new_zeros(())
    for axis in (2, 3):
        length = error.shape[axis] - 1
        difference = error.narrow(axis, 1, length) - error.narrow(axis, 0, length)
        both = torch.minimum(weight.narrow(axis, 1, length), weight.narrow(axis, 0, length))
        total, count = total + (both * difference.square()).sum(), count + both.sum()
    return total / count.clamp(min=_TINY)


def gaussian(picture: Tensor, sigma_px: float) -> Tensor:
    """Convolve (B, C, H, W) with a normalised Gaussian cut off at 3 standard deviations; black beyond the border."""
    radius = math.ceil(3.0 * sigma_px)
    offsets = torch.arange(-radius, radius + 1, dtype=picture.dtype, device=picture.device)
    kernel = torch.exp(-0.5 * (offsets / sigma_px).square())
    kernel = kernel / kernel.sum()
    planes = picture.reshape(-1, 1, *picture.shape[2:])
    planes = functional.conv2d(planes, kernel[None, None, None, :], padding=(0, radius))
    return functional.conv2d(planes, kernel[None, None, :, None], padding=(radius, 0)).reshape(picture.shape)
