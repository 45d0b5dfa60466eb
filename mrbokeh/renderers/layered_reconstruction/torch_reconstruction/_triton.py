"""Triton kernels for NVIDIA GPUs: reprojection with atomic additions, and the sweep over the rows of tiles; imported only with triton.

In the sweep a tile needs the outcome of a row before the next, so that by torch alone each row of all tiles costs a hundred launches.
"""

from typing import no_type_check

import torch
import triton
import triton.language as tl
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import TileLight
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._statistics import Rows

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
    """Splat as `_jobs.splat_in_chunks` does."""
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
    """Splat the samples of one block, for one job, in one program. Planes are colour, opacity, weight and count."""
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


def sweep_by_kernel(
    rows: Rows,
    of_rows: Float64[Tensor, "rows 2"],
    limits: Float64[Tensor, " rows"],
    window: Float64[Tensor, "4"],
    numbers: tuple[float, float, float],
    look_back: int,
) -> tuple[Int64[Tensor, " rows"], Int64[Tensor, " tiles"]]:
    """Sweep as `_partitions.sweep_row_by_row` does."""
    own = torch.empty_like(rows.tile)
    counts = torch.empty_like(rows.first[1:])
    chosen = torch.tensor(numbers, dtype=torch.float64).to(window.device, non_blocking=True)
    with torch.cuda.device_of(own):
        tensors = own, counts, rows.first, rows.sums, of_rows, limits, window, chosen
        _sweep[(len(counts),)](*tensors, look_back, num_warps=1, enable_fp_fusion=False)
    return own, counts


@triton.jit
@no_type_check
def _blur(r, m_x, m_y, d_uu, d_uv, d_vv, d_tt, sigma):
    """`_filter._blur`: xx, xy, yy and determinant."""
    xx = sigma * sigma + r * r * d_uu + d_tt * m_x * m_x
    xy = r * r * d_uv + d_tt * m_x * m_y
    yy = sigma * sigma + r * r * d_vv + d_tt * m_y * m_y
    return xx, xy, yy, tl.maximum(xx * yy - xy * xy, 1e-12)


@triton.jit
@no_type_check
def _extents(n, r, rr, m_x, m_y, m_xx, m_xy, m_yy, d_uu, d_uv, d_vv, d_tt, sigma, bandwidth):
    """`_filter.extents`, from the sums that are its first eight arguments."""
    r, m_x, m_y = r / n, m_x / n, m_y / n
    var_r = tl.maximum(rr / n - r * r, 0.0)
    var_xx, var_xy, var_yy = tl.maximum(m_xx / n - m_x * m_x, 0.0), m_xy / n - m_x * m_y, tl.maximum(m_yy / n - m_y * m_y, 0.0)
    xx, xy, yy, det = _blur(r, m_x, m_y, d_uu, d_uv, d_vv, d_tt, sigma)
    half = 0.5 * (yy * d_uu - 2.0 * xy * d_uv + xx * d_vv) / det
    largest = half + tl.sqrt(tl.maximum(half * half - (d_uu * d_vv - d_uv * d_uv) / det, 0.0))
    kappa_u = 1.0 / (1.0 + bandwidth * bandwidth * var_r * largest)
    kappa_t = 1.0 / (1.0 + bandwidth * bandwidth * d_tt * (yy * var_xx - 2.0 * xy * var_xy + xx * var_yy) / det)
    lens, shutter = kappa_u * (2.0 - kappa_u) * r * r, kappa_t * (2.0 - kappa_t) * d_tt
    v_xx = sigma * sigma + lens * d_uu + shutter * m_x * m_x
    v_xy = lens * d_uv + shutter * m_x * m_y
    v_yy = sigma * sigma + lens * d_vv + shutter * m_y * m_y
    middle, across = 0.5 * (v_xx + v_yy), 0.5 * (v_xx - v_yy)
    longer = tl.sqrt(across * across + v_xy * v_xy)
    return tl.sqrt(middle + longer), tl.sqrt(tl.maximum(middle - longer, 0.0))


@triton.jit
@no_type_check
def _distance(r, m_x, m_y, to_r, to_x, to_y, d_uu, d_uv, d_vv, d_tt, sigma):
    """`_filter.slope_distance`, from mean slopes."""
    xx, xy, yy, det = _blur(r, m_x, m_y, d_uu, d_uv, d_vv, d_tt, sigma)
    off_r, off_x, off_y = to_r - r, to_x - m_x, to_y - m_y
    lens = off_r * off_r * (yy * d_uu - 2.0 * xy * d_uv + xx * d_vv) / (2.0 * det)
    return tl.sqrt(lens + d_tt * (yy * off_x * off_x - 2.0 * xy * off_x * off_y + xx * off_y * off_y) / det)


@triton.jit
@no_type_check
def _sweep(own, counts, first, sums, widths, limits, window, chosen, BACK: tl.constexpr):
    """Sweep one tile in one program. Lanes hold the last BACK partitions, the one of number k in the lane k % BACK."""
    begin, end = tl.load(first + tl.program_id(0)), tl.load(first + tl.program_id(0) + 1)
    d_uu, d_uv, d_vv, d_tt = tl.load(window), tl.load(window + 1), tl.load(window + 2), tl.load(window + 3)
    sigma, bandwidth, least = tl.load(chosen), tl.load(chosen + 1), tl.load(chosen + 2)
    lane = tl.arange(0, BACK)
    none = tl.zeros((BACK,), tl.float64)
    n, r, rr, m_x, m_y, m_xx, m_xy, m_yy = none, none, none, none, none, none, none, none
    widest_u, widest_v, first_r, first_x, first_y = none, none, none, none, none
    count = tl.zeros((), tl.int64)
    for row in range(begin, end):
        one = sums + row * 8
        s_n, s_r, s_rr, s_x = tl.load(one), tl.load(one + 1), tl.load(one + 2), tl.load(one + 3)
        s_y, s_xx, s_xy, s_yy = tl.load(one + 4), tl.load(one + 5), tl.load(one + 6), tl.load(one + 7)
        one_u, one_v, limit = tl.load(widths + row * 2), tl.load(widths + row * 2 + 1), tl.load(limits + row)
        b_n, b_r, b_x, b_y = n + s_n, r + s_r, m_x + s_x, m_y + s_y
        both_u, both_v = _extents(
            b_n, b_r, rr + s_rr, b_x, b_y, m_xx + s_xx, m_xy + s_xy, m_yy + s_yy, d_uu, d_uv, d_vv, d_tt, sigma, bandwidth
        )
        wide = (both_u >= least * tl.maximum(widest_u, one_u)) & (both_v >= least * tl.maximum(widest_v, one_v))
        to_r, to_x, to_y = b_r / b_n, b_x / b_n, b_y / b_n
        begun = _distance(first_r, first_x, first_y, to_r, to_x, to_y, d_uu, d_uv, d_vv, d_tt, sigma)
        added = _distance(s_r / s_n, s_x / s_n, s_y / s_n, to_r, to_x, to_y, d_uu, d_uv, d_vv, d_tt, sigma)
        number = count - 1 - (count - 1 - lane + BACK) % BACK
        fits = (number >= 0) & wide & (begun <= limit) & (added <= limit)
        latest = tl.max(tl.where(fits, number, -1), axis=0)
        joined = tl.where(latest >= 0, latest, count)
        tl.store(own + row, joined)
        here = lane == joined % BACK
        fresh = here & (latest < 0)
        n, r, rr = tl.where(fresh, 0.0, n), tl.where(fresh, 0.0, r), tl.where(fresh, 0.0, rr)
        m_x, m_y = tl.where(fresh, 0.0, m_x), tl.where(fresh, 0.0, m_y)
        m_xx, m_xy, m_yy = tl.where(fresh, 0.0, m_xx), tl.where(fresh, 0.0, m_xy), tl.where(fresh, 0.0, m_yy)
        widest_u, widest_v = tl.where(fresh, 0.0, widest_u), tl.where(fresh, 0.0, widest_v)
        first_r, first_x, first_y = (
            tl.where(fresh, s_r / s_n, first_r),
            tl.where(fresh, s_x / s_n, first_x),
            tl.where(fresh, s_y / s_n, first_y),
        )
        n, r, rr = tl.where(here, n + s_n, n), tl.where(here, r + s_r, r), tl.where(here, rr + s_rr, rr)
        m_x, m_y = tl.where(here, m_x + s_x, m_x), tl.where(here, m_y + s_y, m_y)
        m_xx, m_xy, m_yy = tl.where(here, m_xx + s_xx, m_xx), tl.where(here, m_xy + s_xy, m_xy), tl.where(here, m_yy + s_yy, m_yy)
        widest_u = tl.where(here, tl.maximum(widest_u, one_u), widest_u)
        widest_v = tl.where(here, tl.maximum(widest_v, one_v), widest_v)
        count += latest < 0
    tl.store(counts + tl.program_id(0), count)
