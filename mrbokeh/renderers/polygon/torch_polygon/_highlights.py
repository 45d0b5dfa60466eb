"""Highlights on a device: pixels that give much of the light around them are spread by the kernel of the aperture itself.

The rule is that of `mrbokeh.renderers.polygon._survey_numba`: a pixel that gives more than HIGHLIGHT of the light in the square of four
radii around it, in any channel.
"""

import torch
from jaxtyping import Bool, Float32
from torch import Tensor
from torch.nn.functional import pad

from mrbokeh.layering.torch_layering.slicing import Box
from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.polygon._survey_numba import HIGHLIGHT, TILE_PX
from mrbokeh.renderers.polygon.torch_polygon._batch import Batch

Picture = Float32[Tensor, "height width 4"]
Plane = Float32[Tensor, "height width"]


def shares_of_highlights(values: Picture, coc_px: Plane, from_px: float) -> Plane | None:
    """Return how much of each pixel is spread by its exact kernel; None if there is no highlight."""
    at = torch.nonzero(outshining(values) & (coc_px.abs() > from_px))
    if len(at) == 0:
        return None
    y, x = at.T
    height, width = coc_px.shape
    integral = pad(values.abs().double().cumsum(0).cumsum(1), (0, 0, 1, 0, 1, 0))
    reach = coc_px[y, x].abs().long()
    top, bottom = (y - reach).clamp(min=0), (y + reach + 1).clamp(max=height)
    left, right = (x - reach).clamp(min=0), (x + reach + 1).clamp(max=width)
    around = integral[bottom, right] - integral[top, right] - integral[bottom, left] + integral[top, left]
    light = values[y, x].abs().double()
    ratio = torch.where(light > 0, light / around.clamp(min=1e-300), 0.0).amax(dim=1)
    found = (ratio / HIGHLIGHT - 1.0).clamp(0.0, 1.0).float()
    shares = torch.zeros_like(coc_px)
    shares[y, x] = found
    return shares if bool((found > 0).any()) else None


def outshining(values: Picture) -> Bool[Tensor, "height width"]:
    """Return the mask of pixels that give much of their own tile's light, which their window holds. The picture goes on as in a mirror."""
    height, width, _ = values.shape
    beyond = (0, -width % TILE_PX, 0, -height % TILE_PX)
    mode = "reflect" if min(height, width) >= TILE_PX else "replicate"
    tiles = pad(values.abs().permute(2, 0, 1), beyond, mode=mode).unflatten(2, (-1, TILE_PX)).unflatten(1, (-1, TILE_PX))
    high = (tiles > HIGHLIGHT * tiles.sum(dim=(2, 4), keepdim=True)).any(dim=0)
    return high.flatten(2, 3).flatten(0, 1)[:height, :width]


def stamp(light: Float32[Tensor, "pixels 4"], batch: Batch, shares: Plane, aperture: Aperture) -> None:
    """Add the share of each pixel of the front to the light of its slice, by the exact kernel of the aperture at its diameter."""
    slices, starts = batch.slices, batch.starts.tolist()
    at = torch.nonzero(shares > 0.0)
    y, x = at.T
    coc_px, values = slices.coc_px[0][y, x], slices.values[0][y, x] * (shares * slices.shares[0])[y, x][:, None]
    pieces = slices.order[0][torch.floor(coc_px / slices.step_px + 0.5).long() - slices.first]
    for (row, column), diameter, value, piece in zip(at.tolist(), coc_px.tolist(), values, pieces.tolist(), strict=True):
        if piece < 0:
            continue  # on the border of two slices, by rounding
        kernel = torch.from_numpy(aperture.rasterize(diameter).kernel).to(light)
        reach, seen = kernel.shape[0] // 2, Box(*batch.host[piece][6:10])
        box = Box(row - reach, column - reach, *kernel.shape).within(seen)
        if box.rows == 0 or box.columns == 0:
            continue
        part = kernel[box.top - row + reach :, box.left - column + reach :][: box.rows, : box.columns]
        window = light[starts[piece][1] :][: seen.rows * seen.columns].view(seen.rows, seen.columns, 4)
        window[box.top - seen.top :, box.left - seen.left :][: box.rows, : box.columns] += part[..., None] * value
