"""Which parts of pupil and shutter are merged: `layered_reconstruction._parts_numba` for many tiles."""

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor
from torch.nn.functional import avg_pool2d, interpolate

from mrbokeh.renderers.layered_reconstruction._parts_numba import COARSE_PX, DARK, MOST_RATIO
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import TileLight

Tiles = Float32[Tensor, "tiles channels wide wide"]
Coarse = Float32[Tensor, "tiles channels side side"]


def coarse_inside(light: TileLight, tile: Int64[Tensor, " tiles"]) -> Bool[Tensor, "tiles side side"]:
    """Which coarse pixels of these tiles hold any of the picture."""
    at = torch.arange(light.tile_px // COARSE_PX, device=tile.device) * COARSE_PX
    x, y = (tile % light.columns * light.tile_px)[:, None] + at, (tile // light.columns * light.tile_px)[:, None] + at
    return (y < light.height_px)[:, :, None] & (x < light.width_px)[:, None, :]


def ratio_of(alike: Coarse, apart: Coarse) -> Coarse:
    """Parts over the whole, from 0 to MOST_RATIO, 1 where the whole is 0."""
    return torch.where(alike == 0.0, 1.0, (apart / torch.where(alike == 0.0, 1.0, alike)).clamp(0.0, MOST_RATIO))


def too_detailed(
    alike: Coarse, apart: Coarse, inside: Bool[Tensor, "tiles side side"], tolerance: float
) -> Bool[Tensor, "tiles side side"]:
    """Where coarse pixels cannot hold what parts add to the whole: all in the box around what was found."""
    mask = inside[:, None].float()
    added = (apart - alike) * mask
    mean = avg_pool2d(added, 3, 1, 1) / avg_pool2d(mask, 3, 1, 1).clamp(min=1e-6)
    dark = DARK * (apart.abs() * mask).sum(dim=(2, 3), keepdim=True) / mask.sum(dim=(2, 3), keepdim=True)
    value = torch.maximum(alike.abs(), apart.abs())
    missed = apart - ratio_of(alike, apart) * alike
    found = (torch.maximum((added - mean).abs(), missed.abs()) > tolerance * (value + dark)).any(dim=1) & inside
    return _between_ends(found.any(dim=2))[:, :, None] & _between_ends(found.any(dim=1))[:, None, :]


def _between_ends(found: Bool[Tensor, "tiles side"]) -> Bool[Tensor, "tiles side"]:
    number = found.int()
    return (torch.cumsum(number, 1) > 0) & (torch.cumsum(number.flip(1), 1).flip(1) > 0)


def fine(box: Bool[Tensor, "tiles side side"]) -> Bool[Tensor, "tiles wide wide"]:
    return box.repeat_interleave(COARSE_PX, dim=1).repeat_interleave(COARSE_PX, dim=2)


def scaled_by_coarse(picture: Tiles, ratio: Coarse, inside: Bool[Tensor, "tiles side side"]) -> Tiles:
    """Multiply pictures by coarse pixels, linear between their middles."""
    side = torch.arange(ratio.shape[2], device=ratio.device)
    tile = torch.arange(len(ratio), device=ratio.device)[:, None, None]
    last_y, last_x = (inside.any(dim=axis).sum(dim=1)[:, None] - 1 for axis in (2, 1))
    held = ratio.permute(0, 2, 3, 1)[tile, torch.minimum(side, last_y)[:, :, None], torch.minimum(side, last_x)[:, None, :]]
    return picture * interpolate(held.permute(0, 3, 1, 2), scale_factor=COARSE_PX, mode="bilinear", align_corners=False)
