"""Sums over the samples of each tile and bucket, and the sheared filter that follows from them, for all partitions at once.

The formulas and words are those of `layered_reconstruction._filter_numba`. Sums are (..., 8): count, r, r^2, m_x, m_y, m_x^2, m_x m_y,
m_y^2, with r half the signed circle of confusion, from all samples or a sparse stratified choice in Morton order.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int8, Int64
from torch import Tensor

from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import BLOCKS, TileLight, block_at, place_of

Sums = Float64[Tensor, "*partitions 8"]
Window = Float64[Tensor, "4"]
Number = Float64[Tensor, "*partitions"]


class Slopes(NamedTuple):
    """Mean slopes of a partition and the shares of them that the filter is sheared by."""

    r: Number
    m_x: Number
    m_y: Number
    kappa_u: Number
    kappa_t: Number


class Covariance(NamedTuple):
    """Symmetric matrix of two by two."""

    xx: Number
    xy: Number
    yy: Number


def features(slopes: Tensor) -> Float64[Tensor, "*samples 8"]:
    """Return what samples with slopes (..., 3) add to a row of sums."""
    r, m_x, m_y = slopes.double().unbind(dim=-1)
    return torch.stack([torch.ones_like(r), r, r * r, m_x, m_y, m_x * m_x, m_x * m_y, m_y * m_y], dim=-1)


def sheared_slopes(sums: Sums, window: Window, sigma_x_px: float, bandwidth: float) -> Slopes:
    n, sum_r, sum_rr, sum_x, sum_y, sum_xx, sum_xy, sum_yy = sums.unbind(dim=-1)
    r, m_x, m_y = sum_r / n, sum_x / n, sum_y / n
    var_r = (sum_rr / n - r * r).clamp(min=0.0)
    var_xx, var_xy, var_yy = (sum_xx / n - m_x * m_x).clamp(min=0.0), sum_xy / n - m_x * m_y, (sum_yy / n - m_y * m_y).clamp(min=0.0)
    d_uu, d_uv, d_vv, d_tt = window
    out, det = _blur(r, m_x, m_y, window, sigma_x_px)
    # How far the slopes of single samples leave the mean one, within that band: trace and determinant of V^-1 D.
    half = 0.5 * (out.yy * d_uu - 2.0 * out.xy * d_uv + out.xx * d_vv) / det
    largest = half + torch.sqrt((half * half - (d_uu * d_vv - d_uv * d_uv) / det).clamp(min=0.0))
    trace_m = (out.yy * var_xx - 2.0 * out.xy * var_xy + out.xx * var_yy) / det
    kappa_u = 1.0 / (1.0 + bandwidth**2 * var_r * largest)
    return Slopes(r=r, m_x=m_x, m_y=m_y, kappa_u=kappa_u, kappa_t=1.0 / (1.0 + bandwidth**2 * d_tt * trace_m))


def screen_covariance(slopes: Slopes, window: Window, sigma_x_px: float) -> Covariance:
    """Return the covariance of the Gaussian over the screen."""
    lens = slopes.kappa_u * (2.0 - slopes.kappa_u) * slopes.r**2
    shutter = slopes.kappa_t * (2.0 - slopes.kappa_t) * window[3]
    xx = sigma_x_px**2 + lens * window[0] + shutter * slopes.m_x**2
    return Covariance(xx, lens * window[1] + shutter * slopes.m_x * slopes.m_y, sigma_x_px**2 + lens * window[2] + shutter * slopes.m_y**2)


def axes(v: Covariance) -> tuple[Number, Number, Number]:
    """Return (sigma_u, sigma_v, theta) with sigma_u >= sigma_v and theta the angle of the u axis from x towards y."""
    middle, half = 0.5 * (v.xx + v.yy), torch.hypot(0.5 * (v.xx - v.yy), v.xy)
    return torch.sqrt(middle + half), torch.sqrt((middle - half).clamp(min=0.0)), 0.5 * torch.atan2(2.0 * v.xy, v.xx - v.yy)


def sheared_axes(sigma_u: Number, sigma_v: Number, theta: Number) -> tuple[Number, Number, Number]:
    """Return (s_u, s_v, beta) of Eq. 9: the same Gaussian as one along x after one along (beta, 1)."""
    cosine, sine = torch.cos(theta), torch.sin(theta)
    rho = torch.sqrt((sigma_v * cosine) ** 2 + (sigma_u * sine) ** 2)
    flat, safe = rho == 0.0, rho.clamp(min=1e-300)
    beta = cosine * sine * (sigma_u**2 - sigma_v**2) / safe**2
    return torch.where(flat, sigma_u, sigma_u * sigma_v / safe), rho, torch.where(flat, 0.0, beta)


def extents(sums: Sums, window: Window, sigma_x_px: float, bandwidth: float) -> tuple[Number, Number]:
    """Return standard deviations of the screen-space filter along its axes, the longer first."""
    sigma_u, sigma_v, _ = axes(screen_covariance(sheared_slopes(sums, window, sigma_x_px, bandwidth), window, sigma_x_px))
    return sigma_u, sigma_v


def blur_px(sums: Sums, window: Window, sigma_x_px: float) -> tuple[Number, Number]:
    """Return standard deviations of the blur of the mean sample along its axes, the longer first."""
    r, m_x, m_y = (sums[..., k] / sums[..., 0] for k in (1, 3, 4))
    sigma_u, sigma_v, _ = axes(_blur(r, m_x, m_y, window, sigma_x_px)[0])
    return sigma_u, sigma_v


def slope_distance(one: Sums, other: Sums, window: Window, sigma_x_px: float) -> Number:
    """Return by how much reprojection along the mean slopes of the other goes wrong for the mean sample of one, in units of its own
    blur.
    """
    r, m_x, m_y = (one[..., k] / one[..., 0] for k in (1, 3, 4))
    off_r, off_x, off_y = (other[..., k] / other[..., 0] - mean for k, mean in ((1, r), (3, m_x), (4, m_y)))
    out, det = _blur(r, m_x, m_y, window, sigma_x_px)
    lens = off_r**2 * (out.yy * window[0] - 2.0 * out.xy * window[1] + out.xx * window[2]) / (2.0 * det)
    shutter = window[3] * (out.yy * off_x**2 - 2.0 * out.xy * off_x * off_y + out.xx * off_y**2) / det
    return torch.sqrt(lens + shutter)


def _blur(r: Number, m_x: Number, m_y: Number, window: Window, sigma_x_px: float) -> tuple[Covariance, Number]:
    """Return the blur of the mean sample (what of the spectrum passes pupil, shutter and pixel), and its determinant."""
    out = Covariance(
        sigma_x_px**2 + r * r * window[0] + window[3] * m_x * m_x,
        r * r * window[1] + window[3] * m_x * m_y,
        sigma_x_px**2 + r * r * window[2] + window[3] * m_y * m_y,
    )
    return out, (out.xx * out.yy - out.xy * out.xy).clamp(min=1e-12)


_CHOSEN, _WITHIN, _OUTSIDE = 3, 2, 1
_WORD = np.uint64(0xFFFFFFFF)


@dataclass(frozen=True)
class Rows:
    """Buckets that a tile or its surroundings hold, tile by tile, in the order of buckets.

    sums: (R, 8). tile, bucket: (R,). first: (T + 1,) the first row of each tile, and the end. place: (T, U) the row of every
    bucket of a tile, -1 where it holds none. light: (R, 3) number, light and its root of all samples of the tile and the blocks
    around it.
    """

    sums: Float64[Tensor, "rows 8"]
    light: Float64[Tensor, "rows 3"]
    tile: Int64[Tensor, " rows"]
    bucket: Int64[Tensor, " rows"]
    first: Int64[Tensor, " tiles_and_end"]
    place: Int64[Tensor, "tiles buckets"]


def tile_rows(light: TileLight, every: int, seed: int) -> Rows:
    """Return statistics of what a tile holds, from one sample of `every`, and of what only the blocks around it hold; waits for their
    number.

    Buckets of which no sample was chosen are summed from all of theirs, and count as much as the others.
    """
    tiles, buckets = light.rows * light.columns, light.buckets
    cell = light.block * buckets + light.bucket
    chosen = chosen_samples(light, every, seed)
    holds = torch.zeros((tiles * BLOCKS + 1, buckets), dtype=torch.bool, device=cell.device)
    holds.view(-1)[cell] = True
    ring = ring_of_tiles(light.columns, light.rows, cell.device)
    kind = _kinds(holds, ring)
    kind.view(-1)[light.block[chosen] // BLOCKS * buckets + light.bucket[chosen]] = _CHOSEN
    held = torch.nonzero(kind.view(-1))[:, 0]
    place = torch.where(kind > 0, torch.cumsum(kind.view(-1) > 0, 0).view(kind.shape) - 1, -1)
    needed = torch.nonzero(_needed(kind, ring).view(-1)[cell])[:, 0]
    sums = torch.zeros((len(held), 8), dtype=torch.float64, device=cell.device)
    for sample, tile in ((chosen, light.block[chosen] // BLOCKS), *_unchosen(light, needed, kind)):
        sums.index_add_(0, place[tile, light.bucket[sample]], features(light.slopes[sample]))
    sums /= torch.where(kind.view(-1)[held] == _CHOSEN, 1, every)[:, None]
    tile = held // buckets
    first = torch.searchsorted(tile, torch.arange(tiles + 1, device=cell.device))
    return Rows(sums=sums, light=_light_of_rows(light, place, len(held)), tile=tile, bucket=held % buckets, first=first, place=place)


def _light_of_rows(light: TileLight, place: Int64[Tensor, "tiles buckets"], rows: int) -> Float64[Tensor, "rows 3"]:
    most = light.values.abs().amax(dim=1)
    of_samples = torch.stack([torch.ones_like(most), most, torch.sqrt(most)], dim=1).double()
    sums = of_samples.new_zeros((rows, 3))
    for sample, tile, _ in _touched(light, torch.arange(len(most), device=most.device)):
        sums.index_add_(0, place[tile, light.bucket[sample]], of_samples[sample])
    return sums


def chosen_samples(light: TileLight, every: int, seed: int) -> Int64[Tensor, " chosen"]:
    """Choose one of every so many samples of a tile, the last of those left."""
    device = light.block.device
    if every == 1:
        return torch.arange(len(light.block), device=device)
    first, end = light.starts[:-1:BLOCKS, None], light.starts[BLOCKS::BLOCKS, None]
    steps = -(-light.most_in_tile // every)
    begin = first + torch.arange(steps, device=device) * every
    left = (end - begin).clamp(1, every)
    return (begin + chance(seed, len(first), steps, device) % left)[begin < end]


@lru_cache(maxsize=4)
def chance(seed: int, tiles: int, steps: int, device: torch.device) -> Int64[Tensor, "tiles steps"]:
    """Return the first numbers of a xor-shift generator of each tile (Marsaglia 2003), those of the compiled renderer."""
    start = np.uint64(seed * 2654435761 + 374761393 & 0xFFFFFFFF)
    state = (start + np.arange(tiles, dtype=np.uint64) * np.uint64(2246822519)) & _WORD
    state = np.where(state == 0, np.uint64(1), state)
    for _ in range(4):
        state = _xorshift(state)
    numbers = np.empty((tiles, steps), np.int64)
    for k in range(steps):
        state = _xorshift(state)
        numbers[:, k] = state
    return torch.from_numpy(numbers).to(device)


def _xorshift(state: np.ndarray) -> np.ndarray:
    state = state ^ (state << np.uint64(13)) & _WORD
    state = state ^ state >> np.uint64(17)
    return state ^ (state << np.uint64(5)) & _WORD


@lru_cache(maxsize=4)
def ring_of_tiles(columns: int, rows: int, device: torch.device) -> Int64[Tensor, "20 tiles"]:
    """Return the blocks of other tiles that touch each tile; one beyond the last block outside of the picture."""
    tile = torch.arange(columns * rows, device=device)
    ring = []
    for step_y in range(-1, 5):
        for step_x in range(-1, 5):
            if not (0 <= step_x < 4 and 0 <= step_y < 4):
                x, y = tile % columns * 4 + step_x, tile // columns * 4 + step_y
                inside = (x >= 0) & (x < 4 * columns) & (y >= 0) & (y < 4 * rows)
                ring.append(torch.where(inside, block_at(x.clamp(min=0), y.clamp(min=0), columns), BLOCKS * len(tile)))
    return torch.stack(ring)


def _kinds(holds: Bool[Tensor, "blocks_and_none buckets"], ring: Int64[Tensor, "20 tiles"]) -> Int8[Tensor, "tiles buckets"]:
    """Return which buckets a tile holds, and which only the blocks around it hold."""
    within = holds[:-1].view(-1, BLOCKS, holds.shape[1]).any(dim=1)
    around = holds[ring[0]]
    for blocks in ring[1:]:
        around |= holds[blocks]
    return torch.maximum(within.to(torch.int8) * _WITHIN, around.to(torch.int8) * _OUTSIDE)


def _needed(kind: Int8[Tensor, "tiles buckets"], ring: Int64[Tensor, "20 tiles"]) -> Bool[Tensor, "blocks_and_none buckets"]:
    """Return buckets of each block whose samples count although none was chosen, in its own tile or in one that it touches."""
    within, outside = kind == _WITHIN, kind == _OUTSIDE
    needed = torch.cat([within.repeat_interleave(BLOCKS, dim=0), torch.zeros_like(within[:1])])
    for blocks in ring:
        # A block has the same place in the rings of no two tiles.
        needed[blocks] |= outside
    return needed


def _unchosen(
    light: TileLight, sample: Int64[Tensor, " needed"], kind: Int8[Tensor, "tiles buckets"]
) -> list[tuple[Int64[Tensor, " some"], Int64[Tensor, " some"]]]:
    """Return of these samples those that count for their own tile and for tiles beside, above or below, and across the corner, each
    with its tile.
    """
    found = []
    for some, tile, outside in _touched(light, sample):
        which = torch.nonzero(kind[tile, light.bucket[some]] == (_OUTSIDE if outside else _WITHIN))[:, 0]
        found.append((some[which], tile[which]))
    return found


def _touched(light: TileLight, sample: Int64[Tensor, " samples"]) -> Iterator[tuple[Int64[Tensor, " some"], Int64[Tensor, " some"], bool]]:
    """Yield samples with the tile they lie in, then those of them whose block touches a tile beside, above or below, or across the corner,
    with that tile; and whether it is another.
    """
    x, y = place_of(light.block[sample], light.columns)
    step_x, step_y = (at % 4 // 3 - (3 - at % 4) // 3 for at in (x, y))
    for with_x, with_y in ((0, 0), (1, 0), (0, 1), (1, 1)):
        column, row = x // 4 + with_x * step_x, y // 4 + with_y * step_y
        there = (column >= 0) & (column < light.columns) & (row >= 0) & (row < light.rows)
        there &= ((step_x != 0) | (with_x == 0)) & ((step_y != 0) | (with_y == 0))
        which = torch.nonzero(there)[:, 0]
        yield sample[which], (row * light.columns + column)[which], bool(with_x or with_y)
