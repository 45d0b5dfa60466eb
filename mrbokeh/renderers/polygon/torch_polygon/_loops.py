"""Loops of polygonal differences in plain torch, on any device: what `_triton` does in a few kernels, to the same bits for impulses.

Impulses and their sums are whole numbers, which wrap around without harm: only the picture, the last sum, has to fit.
"""

import torch
from jaxtyping import Float32, Int
from torch import Tensor

from mrbokeh.renderers.polygon.torch_polygon._corners import Along, DeviceTables

Planes = Int[Tensor, "planes rows columns 4"]
Picture = Float32[Tensor, "height width 4"]
Plane = Float32[Tensor, "height width"]


def splat(planes: Planes, values: Picture, radius: Plane, gain: Plane, tables: DeviceTables, scale: float, margin: int) -> None:
    """Add every pixel's impulses, `gain` times its light, to the planes. radius: signed, of its kernel. scale: units of one."""
    rows, columns = planes.shape[1:3]
    real = torch.float32 if planes.dtype == torch.int32 else torch.float64
    y, x = torch.nonzero(gain > 0.0, as_tuple=True)
    r, light = radius[y, x], values[y, x]
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
    assert rows > 2 * margin


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


def sum_down(sums: list[Tensor], tables: DeviceTables, unit: float, margin: int) -> Picture:
    """Return the light inside the margin: profiles laid over the sums, summed downwards; the picture counts in `unit`."""
    total = torch.zeros_like(sums[0])
    rows, columns = total.shape[:2]
    for along, summed in zip(tables.sums, sums, strict=True):
        for x, y, weight in along.taps:
            left, right = max(0, x), min(columns, columns + x)
            total[y:, left:right] += weight * summed[: rows - y, left - x : right - x]
    inside = total.cumsum(dim=0, dtype=total.dtype)[margin : rows - margin, margin : columns - margin]
    return (inside.to(torch.float64) * unit).float()


def spread_small(values: Picture, coc_px: Plane, share: Plane, tables: DeviceTables) -> Picture:
    """Return the light of pixels with whole small kernels: `share` of it, gathered by the places that it reaches."""
    height, width, _ = values.shape
    size, per_px = tables.small.shape[2], tables.tables.exact.per_px
    reach = size // 2
    at = (coc_px.abs().clamp(1.0, tables.tables.exact.to_px) - 1.0) * per_px
    level = at.long().clamp(max=tables.small.shape[1] - 2)
    upper, side = at - level, (coc_px <= 0).long()
    out = torch.zeros((height + 2 * reach, width + 2 * reach, 4), dtype=torch.float32, device=values.device)
    light = values * share[..., None]
    for j in range(size):
        for i in range(size):
            low, high = tables.small[side, level, j, i], tables.small[side, level + 1, j, i]
            out[j : j + height, i : i + width] += light * (low + upper * (high - low))[..., None]
    return out[reach : reach + height, reach : reach + width]
