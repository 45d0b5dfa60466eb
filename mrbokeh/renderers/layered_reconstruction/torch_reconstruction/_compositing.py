"""Jobs of tiles become pictures of tiles, front to back."""

import numpy as np
import torch
from jaxtyping import Float32, Int64
from torch import Tensor

from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import TileLight

_LEAST_WEIGHT = 1e-6
_LEAST_TAKEN = 1e-3

Tiles = Float32[Tensor, "tiles channels side side"]


def composited(
    layers: Float32[Tensor, "jobs planes parts side side"], counts: Int64[np.ndarray, " tiles"], shares: list[float]
) -> tuple[Tiles, Tensor]:
    """e(x) = e_0(x) + sum_j e_j(x) prod_{k<j} (1 - alpha_k(x)), and the product over all that is left, (T, side, side).

    Both are the mean over parts of pupil and shutter, by their shares, each of which is composited on its own.
    layers: colour, opacity and weight, both of which the weight divides, of jobs tile by tile; a layer of no weight is not there.
    counts: of jobs, of each tile. Tiles with most jobs go first, so that a step takes only those that still have one.
    """
    order = np.argsort(-counts, kind="stable")
    starts, back = (torch.from_numpy(each).to(layers.device) for each in ((np.cumsum(counts) - counts)[order], np.argsort(order)))
    out = layers.new_zeros((len(counts), layers.shape[1] - 2, *layers.shape[2:]))
    left = torch.ones_like(out[:, 0])
    for rank in range(int(counts.max())):
        active = int((counts > rank).sum())
        layer = layers[starts[:active] + rank]
        weight = layer[:, -1]
        is_there = weight > _LEAST_WEIGHT
        out[:active] += torch.where(is_there, left[:active] / weight, 0.0)[:, None] * layer[:, :-2]
        left[:active] *= torch.where(is_there, (1.0 - layer[:, -2] / weight).clamp(min=0.0), 1.0)
    weights = torch.tensor(shares, dtype=out.dtype, device=out.device)[:, None, None]
    out, left = (out * weights).sum(dim=2), (left * weights).sum(dim=1)
    # Behind the last layer is nothing that was sampled: what no layer claims belongs to those that were seen.
    taken = 1.0 - left
    return torch.where((taken > _LEAST_TAKEN)[:, None], out / taken[:, None], out)[back], left[back]


def put_together(tiles: Tiles, light: TileLight) -> Float32[Tensor, "height width channels"]:
    """The picture of all tiles, in rows; the last may be cut."""
    channels, side = tiles.shape[1], light.tile_px
    picture = tiles.view(light.rows, light.columns, channels, side, side).permute(0, 3, 1, 4, 2)
    return picture.reshape(light.rows * side, light.columns * side, channels)[: light.height_px, : light.width_px]


def own_means(light: TileLight) -> Float32[Tensor, "height width channels"]:
    """The mean of the samples of each pixel, 0 where it has none."""
    x = light.geometry[:, 0].long().clamp(max=light.width_px - 1)
    y = light.geometry[:, 1].long().clamp(max=light.height_px - 1)
    sums = light.values.new_zeros((light.height_px * light.width_px, light.values.shape[1] + 1))
    sums.index_add_(0, y * light.width_px + x, torch.cat([light.values, torch.ones_like(light.values[:, :1])], dim=1))
    return (sums[:, :-1] / sums[:, -1:].clamp(min=1.0)).view(light.height_px, light.width_px, -1)
