"""Light on a device: samples as they come, and sorted by tile with their slopes, depth buckets, cells of motion and second moments."""

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Float32, Float64, Int32, Int64
from torch import Tensor

from mrbokeh.layering.light_field_samples import LightFieldSamples
from mrbokeh.renderers.layered_reconstruction._settings import Settings


@dataclass(frozen=True)
class DeviceSamples:
    """Samples of one picture in any order, all of it on one device; see LightFieldSamples for what they are.

    values: (N, C) what is reconstructed, linear colour or more. coc_px: (N,) signed diameters of the circle of confusion.
    """

    width_px: int
    height_px: int
    xy_px: Float32[Tensor, "samples 2"]
    lens_uv: Float32[Tensor, "samples 2"]
    time: Float32[Tensor, " samples"]
    values: Float32[Tensor, "samples channels"]
    coc_px: Float32[Tensor, " samples"]
    depth_m: Float32[Tensor, " samples"]
    motion_px: Float32[Tensor, "samples 2"]

    @classmethod
    def of(
        cls,
        samples: LightFieldSamples,
        values: Float32[np.ndarray, "samples channels"],
        coc_px: Float32[np.ndarray, " samples"],
        device: torch.device,
    ) -> "DeviceSamples":
        """Copy samples of the host; their own colour or other values."""
        arrays = samples.xy_px, samples.lens_uv, samples.time, values, coc_px, samples.depth_m, samples.motion_px
        return cls(samples.width_px, samples.height_px, *(torch.from_numpy(np.ascontiguousarray(each)).to(device) for each in arrays))

    @property
    def per_pixel(self) -> float:
        return len(self.time) / (self.width_px * self.height_px)


_OUTLIERS = (0.01, 0.99)
_ENOUGH = 65536  # samples for the percentiles of depth
_FARTHEST_CELL = 32


def depth_buckets(
    coc_px: Float32[Tensor, " samples"], depth_m: Float32[Tensor, " samples"], settings: Settings
) -> Int64[Tensor, " samples"]:
    """Return the bucket of each sample, front to back from 0; see `bucket_of`."""
    near_px, steps = settings.near_coc_px, settings.depth_buckets
    index = torch.floor(coc_px.clamp(-near_px, near_px) / settings.coc_step_px + 0.5)
    some_m = depth_m[:: max(1, len(depth_m) // _ENOUGH)].double()
    some_m = torch.where(torch.isfinite(some_m), some_m, torch.nan)
    low_m, high_m = torch.nanquantile(some_m, torch.tensor(_OUTLIERS, dtype=torch.float64, device=some_m.device))
    is_far = torch.isinf(depth_m)
    share = (depth_m - low_m.float()) * (steps / (high_m - low_m)).float()
    # Infinity falls into a step of its own behind the last.
    cut = torch.minimum(torch.floor(share).clamp(min=0), torch.where(is_far, steps, steps - 1))
    index += torch.where(high_m > low_m, cut, torch.where(is_far, float(steps), 0.0))
    return (index - index.min()).long()


def motion_cells(motion_px: Float32[Tensor, "samples 2"], settings: Settings) -> Int64[Tensor, "samples 2"]:
    """Return column and row of the cell of motion of each sample, from 0."""
    if not settings.motion or not math.isfinite(settings.motion_step_px):
        return torch.zeros_like(motion_px, dtype=torch.int64)
    most_px = settings.motion_step_px * _FARTHEST_CELL
    cells = torch.round(motion_px.clamp(-most_px, most_px) / settings.motion_step_px).long()
    return cells - cells.amin(dim=0)


BLOCKS = 16
"""Squares that a tile is divided into, 4 x 4 in Morton order."""


@dataclass(frozen=True)
class TileLight:
    """Samples sorted by tile, within a tile by pixels in Morton order.

    geometry: (N, 5) x, y, u, v, t - 1/2. slopes: (N, 3) half the signed circle of confusion, motion x and y. values: (N, C).
    block: (N,) the sixteenth of a tile that they lie in, tile by tile, in Morton order. starts: (16 T + 1,) of each, and the end.
    bucket: (N,) among the U buckets that hold anything at all, in the order of depth, then of motion. depth: (U,) of each bucket.
    beside: (U, 10) the buckets next to each in depth and motion, ascending; U where there is none.
    window: second moments uu, uv, vv of the pupil and tt of the shutter, as the samples fill them.
    """

    width_px: int
    height_px: int
    tile_px: int
    geometry: Float32[Tensor, "samples 5"]
    slopes: Float32[Tensor, "samples 3"]
    values: Float32[Tensor, "samples channels"]
    block: Int64[Tensor, " samples"]
    starts: Int64[Tensor, " blocks_and_end"]
    bucket: Int64[Tensor, " samples"]
    depth: Int64[Tensor, " buckets"]
    beside: Int64[Tensor, "buckets 10"]
    window: Float64[Tensor, "4"]
    pupil_radius: float
    per_pixel: float
    most_in_tile: int
    most_in_block: int

    @property
    def columns(self) -> int:
        return -(-self.width_px // self.tile_px)

    @property
    def rows(self) -> int:
        return -(-self.height_px // self.tile_px)

    @property
    def buckets(self) -> int:
        return len(self.depth)


def tile_light(samples: DeviceSamples, settings: Settings) -> TileLight:
    """Sort samples by tile. The host learns here how many buckets there are, how far the pupil reaches, and how
    many samples a tile holds.
    """
    width_px, height_px, tile_px = samples.width_px, samples.height_px, settings.tile_px
    codes = pixel_codes(width_px, height_px, tile_px, samples.time.device)
    pixel = samples.xy_px.int()
    code, order = torch.sort(codes[pixel[:, 1] * (width_px + 1) + pixel[:, 0]], stable=True)
    tiles, per_block = -(-width_px // tile_px) * -(-height_px // tile_px), tile_px**2 // BLOCKS
    borders = torch.arange(tiles * BLOCKS + 1, device=code.device, dtype=code.dtype) * per_block
    starts = torch.searchsorted(code, borders)
    depth, cell = depth_buckets(samples.coc_px, samples.depth_m, settings), motion_cells(samples.motion_px, settings)
    depths, across, down, reach, in_tile, in_block = _learned(depth, cell, samples.lens_uv, starts)
    bucket, held_depth, beside = _held_buckets((depth * down + cell[:, 1]) * across + cell[:, 0], depths, across, down)
    geometry = torch.cat([samples.xy_px, samples.lens_uv, (samples.time - 0.5)[:, None]], dim=1)[order]
    slopes = torch.cat([0.5 * samples.coc_px[:, None], samples.motion_px * float(settings.motion)], dim=1)[order]
    return TileLight(
        width_px=width_px,
        height_px=height_px,
        tile_px=tile_px,
        geometry=geometry,
        slopes=slopes,
        values=samples.values[order],
        block=(code // per_block).long(),
        starts=starts,
        bucket=bucket[order],
        depth=held_depth,
        beside=beside,
        window=_window(samples),
        pupil_radius=reach,
        per_pixel=samples.per_pixel,
        most_in_tile=int(in_tile),
        most_in_block=int(in_block),
    )


@lru_cache(maxsize=4)
def pixel_codes(width_px: int, height_px: int, tile_px: int, device: torch.device) -> Int32[Tensor, " pixels"] | Int64[Tensor, " pixels"]:
    """Return the place of each pixel in the order of samples; the border to the right and below counts as the last pixels."""
    columns_px, rows_px = (torch.arange(size + 1, device=device).clamp(max=size - 1) for size in (width_px, height_px))
    y, x = torch.meshgrid(rows_px, columns_px, indexing="ij")
    columns, rows = -(-width_px // tile_px), -(-height_px // tile_px)
    code = ((y // tile_px) * columns + x // tile_px) * tile_px**2 + morton(x % tile_px, y % tile_px)
    return code.view(-1).to(torch.int32 if columns * rows * tile_px**2 < 1 << 31 else torch.int64)


def block_at(x: Int64[Tensor, "*place"], y: Int64[Tensor, "*place"], columns: int) -> Int64[Tensor, "*place"]:
    """Return the number of the block in this column and row of blocks of the picture. columns: of tiles."""
    return ((y // 4) * columns + x // 4) * BLOCKS + morton(x % 4, y % 4)


def place_of(block: Int64[Tensor, "*place"], columns: int) -> tuple[Int64[Tensor, "*place"], Int64[Tensor, "*place"]]:
    """Return the inverse of `block_at`."""
    tile, within = block // BLOCKS, block % BLOCKS
    x, y = (within & 1) | ((within >> 1) & 2), ((within >> 1) & 1) | ((within >> 2) & 2)
    return tile % columns * 4 + x, tile // columns * 4 + y


def morton(x: Int64[Tensor, "*place"], y: Int64[Tensor, "*place"]) -> Int64[Tensor, "*place"]:
    """Return the bits of x and y, below 256, interleaved, x first."""
    return _spread_bits(x) | (_spread_bits(y) << 1)


def _spread_bits(number: Int64[Tensor, "*place"]) -> Int64[Tensor, "*place"]:
    for shift, mask in ((4, 0x0F0F), (2, 0x3333), (1, 0x5555)):
        number = (number | (number << shift)) & mask
    return number


def _learned(depth: Tensor, cell: Tensor, lens_uv: Tensor, starts: Tensor) -> tuple[int, int, int, float, float, float]:
    """Depth buckets, cells of motion on both axes, the pupil's reach, most samples in a tile and a block; waits."""
    counts = starts.diff()
    most = lens_uv.abs().max(), counts.view(-1, BLOCKS).sum(dim=1).max(), counts.max()
    known = torch.stack([each.double() for each in (depth.max() + 1, *(cell.amax(dim=0) + 1), *most)])
    depths, across, down, *rest = known.tolist()
    return int(depths), int(across), int(down), rest[0], rest[1], rest[2]


def _held_buckets(
    bucket: Int64[Tensor, " samples"], depths: int, across: int, down: int
) -> tuple[Int64[Tensor, " samples"], Int64[Tensor, " buckets"], Int64[Tensor, "buckets 10"]]:
    """Return buckets of samples among those that hold any, the depth of each and its neighbours; waits to learn how many."""
    is_held = torch.zeros(depths * across * down, dtype=torch.bool, device=bucket.device)
    is_held[bucket] = True
    held = torch.nonzero(is_held)[:, 0]
    place = torch.where(is_held, torch.cumsum(is_held, 0) - 1, len(held))
    depth = held // (across * down)
    steps = [(-1, 0, 0), *((0, dy, dx) for dy in (-1, 0, 1) for dx in (-1, 0, 1) if (dx, dy) != (0, 0)), (1, 0, 0)]
    sizes, moves = (torch.tensor(each, device=bucket.device) for each in ((depths, down, across), steps))
    at = torch.stack([depth, held // across % down, held % across], dim=1)[:, None] + moves
    inside = ((at >= 0) & (at < sizes)).all(dim=2)
    beside = place[torch.where(inside, (at[..., 0] * down + at[..., 1]) * across + at[..., 2], 0)]
    return place[bucket], depth, torch.where(inside, beside, len(held))


def _window(samples: DeviceSamples) -> Float64[Tensor, "4"]:
    u, v, t = samples.lens_uv[:, 0], samples.lens_uv[:, 1], samples.time - 0.5
    return torch.stack([u * u, u * v, v * v, t * t]).mean(dim=1, dtype=torch.float64)
