"""Reprojection as one kernel with atomic additions, for NVIDIA GPUs; imported only where triton is there."""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float32, Int64
from torch import Tensor

from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import TileLight

_SAMPLES = 64


def splat_by_kernel(
    planes: Float32[Tensor, "pixels planes"],
    light: TileLight,
    slope: Float32[Tensor, "group 3"],
    facts: Int64[Tensor, "group 10"],
    place: Int64[Tensor, "tiles buckets"],
    entry: Int64[Tensor, " entries"],
    block: Int64[Tensor, " entries"],
    side: int,
) -> None:
    """See `_reprojection.splat_in_chunks`, its twin."""
    tensors = planes, light.geometry, light.values, light.bucket, light.depth, light.starts, slope, facts, place, entry, block
    channels = light.values.shape[1]
    wide = triton.next_power_of_2(channels + 3)
    if len(entry):
        with torch.cuda.device_of(planes):
            _splat[(len(entry),)](*tensors, light.buckets, side, channels, wide, _SAMPLES, enable_fp_fusion=False)


@triton.jit
@no_type_check
def _splat(
    planes,
    geometry,
    values,
    bucket,
    depth,
    starts,
    slope,
    facts,
    place,
    entry,
    block,
    buckets,
    side,
    CHANNELS: tl.constexpr,
    WIDE: tl.constexpr,
    SAMPLES: tl.constexpr,
):
    """One program: the samples of one block, for one job. Planes are colour, opacity, weight and count."""
    group, at_block = tl.load(entry + tl.program_id(0)), tl.load(block + tl.program_id(0))
    first, end = tl.load(starts + at_block), tl.load(starts + at_block + 1)
    a, b_x, b_y = tl.load(slope + group * 3), tl.load(slope + group * 3 + 1), tl.load(slope + group * 3 + 2)
    fact = facts + group * 10
    corner_x, corner_y, low_x, low_y = tl.load(fact), tl.load(fact + 1), tl.load(fact + 2), tl.load(fact + 3)
    high_x, high_y, is_sharp, nearest = tl.load(fact + 4), tl.load(fact + 5), tl.load(fact + 6), tl.load(fact + 7)
    own, tile = tl.load(fact + 8), tl.load(fact + 9)
    plane = tl.arange(0, WIDE)
    for begin in range(first, end, SAMPLES):
        sample = begin + tl.arange(0, SAMPLES)
        there = sample < end
        ray = geometry + sample * 5
        u, v, t = tl.load(ray + 2, there, 0.0), tl.load(ray + 3, there, 0.0), tl.load(ray + 4, there, 0.0)
        x = tl.load(ray, there, 0.0) - a * u - b_x * t - corner_x.to(tl.float32)
        y = tl.load(ray + 1, there, 0.0) - a * v - b_y * t - corner_y.to(tl.float32)
        x = tl.where(is_sharp != 0, tl.floor(x), x - 0.5)
        y = tl.where(is_sharp != 0, tl.floor(y), y - 0.5)
        hits = there & (x >= low_x) & (x < high_x) & (y >= low_y) & (y < high_y)
        of = tl.load(bucket + sample, hits, 0)
        hits = hits & (tl.load(depth + of, hits, 0) >= nearest)
        before = tl.load(place + tile * buckets + of, hits, 0) - own
        colour = tl.load(values + sample[:, None] * CHANNELS + plane[None, :], hits[:, None] & (plane < CHANNELS)[None, :], 1.0)
        counts = (plane == CHANNELS + 2)[None, :] | ((plane == CHANNELS + 1)[None, :] & (before >= 0)[:, None])
        counts = counts | ((plane <= CHANNELS)[None, :] & (before == 0)[:, None])
        counts = counts & hits[:, None]
        column, row = tl.floor(x), tl.floor(y)
        corner = (group * side + row.to(tl.int64)) * side + column.to(tl.int64)
        for tap in tl.static_range(4):
            share_x = x - column if tap % 2 == 1 else 1.0 - (x - column)
            share_y = y - row if tap // 2 == 1 else 1.0 - (y - row)
            share = share_x * share_y
            target = (corner + (tap // 2) * side + tap % 2)[:, None] * (CHANNELS + 3) + plane[None, :]
            tl.atomic_add(planes + target, colour * share[:, None], mask=counts & (share > 0.0)[:, None], sem="relaxed")
