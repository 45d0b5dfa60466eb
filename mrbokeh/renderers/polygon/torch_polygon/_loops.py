"""Loops of polygonal differences in plain torch, on any device: what `_triton` does in a few kernels, to the same bits for impulses.

Impulses and their sums are whole numbers, which wrap around without harm: only the picture, the last sum, has to fit.
"""

import torch
from jaxtyping import Float32, Int
from torch import Tensor

from mrbokeh.layering.torch_layering.slicing import Slices
from mrbokeh.renderers.polygon.torch_polygon._batch import Batch
from mrbokeh.renderers.polygon.torch_polygon._corners import Along, DeviceTables
from mrbokeh.renderers.polygon.torch_polygon._highlights import outshining

Planes = Int[Tensor, "planes rows columns 4"]
Picture = Float32[Tensor, "height width 4"]
Plane = Float32[Tensor, "height width"]


def survey(values: Picture, coc_px: Plane) -> Float32[Tensor, "7"]:
    """Return the strongest value, the largest diameter of a pixel with light, inf if one has none, 1 if a pixel gives much of its tile's
    light, and how far below 0 each channel goes.
    """
    size = torch.where((values != 0).any(dim=2), torch.nan_to_num(coc_px.abs(), torch.inf), 0.0)
    below = (-values).amax(dim=(0, 1)).clamp(min=0.0)
    return torch.cat([torch.stack([values.abs().amax(), size.amax(), outshining(values).any().float()]), below])


def sum_slices(
    slices: Slices, kept: Plane | None, tables: DeviceTables, most: float, lowest: Float32[Tensor, "4"], whole: torch.dtype
) -> tuple[Float32[Tensor, "pixels 4"], Batch]:
    """Return the light of all slices, one after the other, and where each lies.

    kept: the share of each pixel of the front that is no highlight; None for all. most: no light is stronger. lowest: below what no channel
    of the result falls. whole: numbers of the sums.
    """
    batch = Batch.of(slices, tables, most, whole)
    light = []
    for place, scales in zip(batch.host, batch.scales.tolist(), strict=True):
        kind, number, _, _, _, _, top, left, rows, columns, rest = place
        layer = min(kind, 1)
        mine = slices.shares[kind] * (torch.floor(slices.coc_px[layer] / slices.step_px + 0.5) == number)
        values, coc_px = slices.values[layer] * mine[..., None], slices.coc_px[layer]
        out = spread_small(values, coc_px, tables)
        if rest & 2:
            margin = rest // 8
            size = len(coc_px) + 2 * margin, coc_px.shape[1] + 2 * margin, 4
            planes = torch.zeros((tables.planes, *size), dtype=whole, device=values.device)
            splat(planes, values, coc_px, kept if kind == 0 else None, tables, scales[0], margin)
            sums = torch.stack([sum_along(planes, along) for along in tables.sums])
            out = torch.maximum(out + sum_down(sums, tables, scales[1], margin), lowest)
        light.append(out[top : top + rows, left : left + columns].reshape(-1, 4))
    return torch.cat(light), batch


def summed_shares(coc_px: Plane, tables: DeviceTables) -> Plane:
    """Return how much of each pixel's light goes through impulses and sums; the rest goes by whole small kernels."""
    exact = tables.tables.exact
    return ((coc_px.abs() - exact.from_px) / (exact.to_px - exact.from_px)).clamp(0.0, 1.0)


def splat(planes: Planes, values: Picture, coc_px: Plane, kept: Plane | None, tables: DeviceTables, scale: float, margin: int) -> None:
    """Add the impulses of what goes through sums to the planes. kept: the share of a pixel that is no highlight. scale: units of one."""
    columns = planes.shape[2]
    real = torch.float32 if planes.dtype == torch.int32 else torch.float64
    gain = summed_shares(coc_px, tables) * (1.0 if kept is None else kept)
    y, x = torch.nonzero((gain > 0.0) & (values != 0).any(dim=2), as_tuple=True)
    r, light = torch.sqrt(0.25 * coc_px[y, x] ** 2 + tables.tables.corners.growth), values[y, x]
    r = torch.where(coc_px[y, x] > 0, r, -r)
    slope, shift, origin, curvature = tables.edges.T[:, :, None]
    offset = slope * r + (origin + torch.where(r > 0, shift, -shift))
    line = torch.floor(offset)
    share, line = offset - line, line.long()
    area = tables.tables.corners.area
    whole = area[0] * r * r + area[1] + (curvature * share * (1.0 - share)).sum(dim=0)
    light = (light * (gain[y, x] / whole)[:, None]).to(real) * scale
    here = (y + margin) * columns + x + margin
    for corner, weight in zip(tables.corners.tolist(), tables.weights.tolist(), strict=True):
        before, after, *steps, plane = corner
        at = here + _place(line[before], steps[0], steps[1], columns) + _place(line[after], steps[2], steps[3], columns)
        flat = planes[plane].view(-1, 4)
        for on, of_before in ((0, 1.0 - share[before]), (1, share[before])):
            for on_after, of_after in ((0, 1.0 - share[after]), (1, share[after])):
                to = at + on * (steps[1] * columns + steps[0]) + on_after * (steps[3] * columns + steps[2])
                impulse = light * (weight * of_before * of_after).to(real)[:, None]
                flat.index_add_(0, to, torch.floor(impulse + 0.5).to(planes.dtype))


def _place(line: Tensor, step_x: int, step_y: int, columns: int) -> Tensor:
    return line * (step_y * columns + step_x)


def sum_along(planes: Planes, along: Along) -> Int[Tensor, "rows columns 4"]:
    """Return the sum along one direction of the planes that feed it."""
    total = sum(sign * planes[plane] for plane, sign in along.inputs)
    assert isinstance(total, Tensor)
    dx, dy = along.step
    if dy == 0:
        return total.cumsum(dim=1, dtype=total.dtype)
    for y in range(dy, len(total)):
        to, source = total[y], total[y - dy]
        if dx > 0:
            to[dx:] += source[:-dx]
        else:
            to[:dx] += source[-dx:]
    return total


def sum_down(sums: Int[Tensor, "directions rows columns 4"], tables: DeviceTables, unit: float, margin: int) -> Picture:
    """Return the light inside the margin: profiles laid over the sums, summed downwards. unit: what one of the sums means."""
    total = torch.zeros_like(sums[0])
    rows, columns = total.shape[:2]
    for along, summed in zip(tables.sums, sums, strict=True):
        for x, y, weight in along.taps:
            left, right = max(0, x), min(columns, columns + x)
            total[y:, left:right] += weight * summed[: rows - y, left - x : right - x]
    inside = total.cumsum(dim=0, dtype=total.dtype)[margin : rows - margin, margin : columns - margin]
    return (inside.to(torch.float64) * unit).float()


def spread_small(values: Picture, coc_px: Plane, tables: DeviceTables) -> Picture:
    """Return the light that goes by whole small kernels, gathered by the places that it reaches."""
    height, width, _ = values.shape
    size, per_px = tables.small.shape[2], tables.tables.exact.per_px
    reach = size // 2
    at = (coc_px.abs().clamp(1.0, tables.tables.exact.to_px) - 1.0) * per_px
    level = at.long().clamp(max=tables.small.shape[1] - 2)
    upper, side = at - level, (coc_px <= 0).long()
    out = torch.zeros((height + 2 * reach, width + 2 * reach, 4), dtype=torch.float32, device=values.device)
    light = values * (1.0 - summed_shares(coc_px, tables))[..., None]
    for j in range(size):
        for i in range(size):
            low, high = tables.small[side, level, j, i], tables.small[side, level + 1, j, i]
            out[j : j + height, i : i + width] += light * (low + upper * (high - low))[..., None]
    return out[reach : reach + height, reach : reach + width]
