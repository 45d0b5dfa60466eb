"""Reprojection of the samples around tiles along the slopes of their partitions (Eq. 1), into one window for each job."""

import torch
from jaxtyping import Bool, Float32, Int64
from torch import Tensor

from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._jobs import Jobs, Task
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import TileLight
from mrbokeh.system.torch_device import has_triton

Windows = Float32[Tensor, "group side side planes"]


def reprojected(jobs: Jobs, light: TileLight, task: Task, enough: float, pairs_at_once: int) -> Windows:
    """Colour, opacity and weight (C + 2) of each place of each window.

    A sample of the partition adds its values and an opacity, a weight and a count of 1. One behind adds a weight and a count: it
    was seen through this place. One just in front adds a count alone, one far in front nothing. No place weighs more than
    `enough` samples do.
    """
    planes = light.values.new_zeros((len(task.job) * task.side**2, light.values.shape[1] + 3))
    tables = jobs.slope[task.job], task.facts, jobs.partitions.place, task.entry, task.block, task.side
    if planes.device.type == "cuda" and has_triton():
        from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._reprojection_triton import splat_by_kernel

        splat_by_kernel(planes, light, *tables)
    else:
        splat_in_chunks(planes, light, *tables, pairs_at_once)
    planes, totals = planes[:, :-1], planes[:, -1:]
    planes = torch.where(totals > enough, planes * (enough / totals), planes)
    return planes.view(len(task.job), task.side, task.side, -1)


def splat_in_chunks(
    planes: Float32[Tensor, "pixels planes"],
    light: TileLight,
    slope: Float32[Tensor, "group 3"],
    facts: Int64[Tensor, "group 10"],
    place: Int64[Tensor, "tiles buckets"],
    entry: Int64[Tensor, " entries"],
    block: Int64[Tensor, " entries"],
    side: int,
    pairs_at_once: int = 1 << 18,
) -> None:
    """Add all samples of each block to planes (G side side, C + 3): colour, opacity, weight and count. facts: see Jobs."""
    step = max(1, pairs_at_once // light.most_in_block)
    for begin in range(0, len(entry), step):
        _add_blocks(planes, light, slope, facts, place, entry[begin : begin + step], block[begin : begin + step], side)


def _add_blocks(
    planes: Float32[Tensor, "pixels planes"],
    light: TileLight,
    slope: Float32[Tensor, "group 3"],
    facts: Int64[Tensor, "group 10"],
    place: Int64[Tensor, "tiles buckets"],
    group: Int64[Tensor, " entries"],
    block: Int64[Tensor, " entries"],
    side: int,
) -> None:
    """See `splat_in_chunks`; all at once."""
    corner_x, corner_y, low_x, low_y, high_x, high_y, is_sharp, nearest, own, tile = facts[group][:, :, None].unbind(dim=1)
    sample = light.starts[block][:, None] + torch.arange(light.most_in_block, device=block.device)
    is_there = sample < light.starts[block + 1][:, None]
    sample = sample.clamp(max=len(light.bucket) - 1)
    x, y = landing(light.geometry[sample], slope[group][:, None], torch.cat([corner_x, corner_y], dim=1)[:, None].float(), is_sharp > 0)
    bucket = light.bucket[sample]
    hits = is_there & (x >= low_x) & (x < high_x) & (y >= low_y) & (y < high_y) & (light.depth[bucket] >= nearest)
    which, _ = torch.nonzero(hits, as_tuple=True)
    before = place[tile[which, 0], bucket[hits]] - own[which, 0]
    shares = torch.stack([before == 0, before >= 0, before == before], dim=1)
    worth = torch.cat([light.values[sample[hits]] * shares[:, :1], shares], dim=1)
    x, y = x[hits], y[hits]
    column, row = torch.floor(x), torch.floor(y)
    corner = (group[which] * side + row.long()) * side + column.long()
    for step_y, share_y in ((0, 1.0 - (y - row)), (1, y - row)):
        for step_x, share_x in ((0, 1.0 - (x - column)), (1, x - column)):
            # One that keeps its pixel adds nothing to the next, which may lie outside.
            share = share_x * share_y
            planes.index_add_(0, corner + torch.where(share > 0.0, step_y * side + step_x, 0), worth * share[:, None])


def landing(
    geometry: Float32[Tensor, "blocks samples 5"],
    slope: Float32[Tensor, "blocks 1 3"],
    corner: Float32[Tensor, "blocks 1 2"],
    is_sharp: Bool[Tensor, "blocks 1"],
) -> tuple[Float32[Tensor, "blocks samples"], Float32[Tensor, "blocks samples"]]:
    """Where samples come to lie in the window: among the centres of pixels; those that hardly move keep the pixel that they are in."""
    x = geometry[..., 0] - slope[..., 0] * geometry[..., 2] - slope[..., 1] * geometry[..., 4] - corner[..., 0]
    y = geometry[..., 1] - slope[..., 0] * geometry[..., 3] - slope[..., 2] * geometry[..., 4] - corner[..., 1]
    return torch.where(is_sharp, torch.floor(x), x - 0.5), torch.where(is_sharp, torch.floor(y), y - 0.5)
