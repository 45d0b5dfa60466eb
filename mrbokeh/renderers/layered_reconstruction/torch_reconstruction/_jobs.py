"""Jobs: one partition of one tile each, how it is reprojected and filtered, and its samples reprojected into a window of its own (Eq. 1).

Jobs go through a step together in groups of equal windows.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from mrbokeh.renderers.layered_reconstruction._filter_numba import BESIDE_DEPTHS
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import TileLight, block_at
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._partitions import Partitions
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._statistics import Slopes
from mrbokeh.system.torch_device import has_triton

GUARDS_PX = (1, 3, 7, 15, 31, 47, 79, 111, 175, 239, 367, 495)
"""Jobs are grouped by their guard bands, up to the next of these: a few sizes of windows, little of them empty,
and with a tile of 32 px a transform of a power of two or thrice that."""


_SHARP_PX = 0.5


@dataclass(frozen=True)
class Jobs:
    """Jobs of all partitions. slope: (P, 3) of the reprojection, a, b_x, b_y. guard: (P, 2) how far the filter reads beyond the tile, x
    and y.

    facts: (P, 10) relative to the corner of a window without a guard band: corner in the picture, first pixel that belongs to
    the job, the one after the last a sample may come to lie in (x and y each), whether samples keep their pixels, the nearest
    depth bucket that counts, 2 rank, tile.
    blocks: (P, 4) blocks of samples to look at, of all that may come into the window: first, x and y, how many along x and in all.
    """

    partitions: Partitions
    slopes: Slopes
    slope: Float32[Tensor, "jobs 3"]
    guard: Int64[Tensor, "jobs 2"]
    facts: Int64[Tensor, "jobs 10"]
    blocks: Int64[Tensor, "jobs 4"]
    host_guard: Int64[np.ndarray, "jobs 2"]
    host_blocks: Int64[np.ndarray, " jobs"]
    host_counts: Int64[np.ndarray, " tiles"]


@dataclass(frozen=True)
class Task:
    """Jobs whose windows are equally large. job: (G,). facts: (G, 10) of Jobs, of windows with their guard bands. side: of each.

    entry, block: (E,) pairs of a job of the group and a block of samples.
    """

    job: Int64[Tensor, " group"]
    facts: Int64[Tensor, "group 10"]
    side: int
    entry: Int64[Tensor, " entries"]
    block: Int64[Tensor, " entries"]


def jobs_of(partitions: Partitions, slopes: Slopes, guard: Int64[Tensor, "jobs 2"], light: TileLight, shared_out: bool) -> Jobs:
    """Make the jobs. The host learns here how many jobs each tile has, how wide their windows are and how many blocks of
    samples they look at.

    shared_out: samples that move are shared out among the four nearest pixels, else all keep the pixel they come into.
    """
    slope = torch.stack([slopes.kappa_u * slopes.r, slopes.kappa_t * slopes.m_x, slopes.kappa_t * slopes.m_y], dim=1)
    reach_px = slope[:, :1].abs() * light.pupil_radius + 0.5 * slope[:, 1:].abs()
    tile, side = partitions.tile, light.tile_px
    corner = torch.stack([tile % light.columns, tile // light.columns], dim=1) * side
    end = torch.stack([(corner[:, 0] + side).clamp(max=light.width_px), (corner[:, 1] + side).clamp(max=light.height_px)], dim=1)
    is_sharp = ((reach_px < _SHARP_PX).all(dim=1, keepdim=True) | (not shared_out)).long()
    others = torch.stack([partitions.nearest - BESIDE_DEPTHS, 2 * partitions.rank, tile], dim=1)
    facts = torch.cat([corner, -guard, end - corner + guard - (1 - is_sharp), is_sharp, others], dim=1)
    blocks = _blocks(corner, end, guard + reach_px + 1.0, light)
    known = torch.cat([guard, blocks[:, 3:]], dim=1).cpu().numpy()
    counts = partitions.counts.cpu().numpy()
    return Jobs(
        partitions=partitions,
        slopes=slopes,
        slope=slope.float(),
        guard=guard,
        facts=facts,
        blocks=blocks,
        host_guard=known[:, :2],
        host_blocks=known[:, 2],
        host_counts=counts,
    )


def _blocks(
    corner: Int64[Tensor, "jobs 2"], end: Int64[Tensor, "jobs 2"], beyond_px: Float64[Tensor, "jobs 2"], light: TileLight
) -> Int64[Tensor, "jobs 4"]:
    """Return the first block along x and y, number along x, number in all, of those within some pixels of a tile."""
    side = light.tile_px // 4
    low = torch.floor((corner - beyond_px) / side).long().clamp(min=0)
    high = torch.floor((end + beyond_px) / side).long()
    count_x = high[:, 0].clamp(max=4 * light.columns - 1) - low[:, 0] + 1
    count_y = high[:, 1].clamp(max=4 * light.rows - 1) - low[:, 1] + 1
    return torch.stack([low[:, 0], low[:, 1], count_x, count_x * count_y], dim=1)


def task_of(jobs: Jobs, light: TileLight, members: Int64[np.ndarray, " group"], guard: int) -> Task:
    """Make a task of some jobs, with a guard band that is as wide as theirs or wider."""
    device, entries = jobs.facts.device, int(jobs.host_blocks[members].sum())
    job = torch.from_numpy(members).to(device)
    first_x, first_y, across, count = jobs.blocks[job].unbind(dim=1)
    entry = torch.repeat_interleave(count, output_size=entries)
    within = torch.arange(entries, device=device) - (torch.cumsum(count, 0) - count)[entry]
    x, y = first_x[entry] + within % across[entry], first_y[entry] + within // across[entry]
    block = block_at(x, y, light.columns)
    moved = torch.tensor([-guard] * 2 + [guard] * 4 + [0] * 4, device=device)
    return Task(job=job, facts=jobs.facts[job] + moved, side=light.tile_px + 2 * guard, entry=entry, block=block)


def batches(jobs: Jobs, jobs_at_once: int) -> Iterator[tuple[int, int]]:
    """Yield first and end of runs of tiles with at most so many jobs together, or of single tiles."""
    ends = np.cumsum(jobs.host_counts)
    begin, before = 0, 0
    while begin < len(ends):
        end = max(int(np.searchsorted(ends, before + jobs_at_once, side="right")), begin + 1)
        yield begin, end
        begin, before = end, int(ends[end - 1])


def jobs_in(jobs: Jobs, tiles: Int64[np.ndarray, " tiles"]) -> Int64[np.ndarray, " jobs"]:
    """Return all jobs of these tiles, which must rise."""
    ends = np.cumsum(jobs.host_counts)
    return np.concatenate([np.arange(ends[tile] - jobs.host_counts[tile], ends[tile]) for tile in tiles.tolist()])


def groups(
    jobs: Jobs, some: Int64[np.ndarray, " jobs"], tile_px: int, pixels_at_once: int
) -> Iterator[tuple[Int64[np.ndarray, " group"], int]]:
    """Yield groups of jobs that share a guard band, and the band; no more than so many pixels of windows together."""
    widest = jobs.host_guard[some].max(axis=1)
    band = np.searchsorted(GUARDS_PX, widest)
    for which in np.unique(band).tolist():
        guard = GUARDS_PX[which] if which < len(GUARDS_PX) else int(widest.max())
        members = some[band == which]
        at_once = max(1, pixels_at_once // (tile_px + 2 * guard) ** 2)
        for begin in range(0, len(members), at_once):
            yield members[begin : begin + at_once], guard


Windows = Float32[Tensor, "group side side planes"]


def reprojected(jobs: Jobs, light: TileLight, task: Task, enough: float, pairs_at_once: int) -> Windows:
    """Return colour, opacity and weight (C + 2) of each place of each window.

    A sample of the partition adds its values and an opacity, a weight and a count of 1. One behind adds a weight and a count: it
    was seen through this place. One just in front adds a count alone, one far in front nothing. No place weighs more than
    `enough` samples do.
    """
    planes = light.values.new_zeros((len(task.job) * task.side**2, light.values.shape[1] + 3))
    tables = jobs.slope[task.job], task.facts, jobs.partitions.place, task.entry, task.block, task.side
    if planes.device.type == "cuda" and has_triton():
        from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._triton import splat_by_kernel

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
    """Add blocks as `splat_in_chunks` says, all at once."""
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
    """Return where samples come to lie in the window, among the centres of pixels; samples that hardly move keep their pixel."""
    x = geometry[..., 0] - slope[..., 0] * geometry[..., 2] - slope[..., 1] * geometry[..., 4] - corner[..., 0]
    y = geometry[..., 1] - slope[..., 0] * geometry[..., 3] - slope[..., 2] * geometry[..., 4] - corner[..., 1]
    return torch.where(is_sharp, torch.floor(x), x - 0.5), torch.where(is_sharp, torch.floor(y), y - 0.5)
