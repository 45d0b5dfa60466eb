"""Partitions of tiles: rows of a tile join them, one row of every tile at a time, and every bucket finds its place among them."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from mrbokeh.renderers.layered_reconstruction._partitions_numba import LOOK_BACK, WIDEST_PX
from mrbokeh.renderers.layered_reconstruction._settings import Settings
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._light import TileLight
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._statistics import Rows, blur_px, extents, slope_distance
from mrbokeh.system.torch_device import has_triton


@dataclass(frozen=True)
class Partitions:
    """Partitions of all tiles, tile by tile, front to back.

    sums: (P, 8). tile, rank: (P,) the tile and the number within it. nearest: (P,) the first depth bucket. place: (T, U) where each
    bucket lies among those of a tile: 2 rank in one, 2 rank - 1 before it. counts: (T,) of each tile.
    """

    sums: Float64[Tensor, "partitions 8"]
    tile: Int64[Tensor, " partitions"]
    rank: Int64[Tensor, " partitions"]
    nearest: Int64[Tensor, " partitions"]
    place: Int64[Tensor, "tiles buckets"]
    counts: Int64[Tensor, " tiles"]


def partitions_of(rows: Rows, light: TileLight, settings: Settings) -> Partitions:
    faint = faint_rows(rows, light, settings)
    seen = torch.nonzero(~faint)[:, 0]
    own_rows = {name: getattr(rows, name)[seen] for name in ("sums", "light", "tile", "bucket")}
    first = torch.searchsorted(own_rows["tile"], torch.arange(len(rows.first), device=seen.device))
    swept, counts = merged_rows(replace(rows, first=first, **own_rows), light.window, settings)
    before = torch.cumsum(counts, 0) - counts
    of = before[rows.tile[seen]] + swept
    tile = torch.repeat_interleave(counts)
    sums = torch.zeros((len(tile), 8), dtype=torch.float64, device=of.device).index_add_(0, of, rows.sums[seen])
    own = torch.empty_like(rows.tile)
    own[seen] = swept
    own[faint] = _by_slopes(rows, torch.nonzero(faint)[:, 0], sums, counts, light, settings)
    depth = light.depth[rows.bucket[seen]]
    nearest = torch.full_like(tile, torch.iinfo(torch.int64).max).scatter_reduce_(0, of, depth, "amin")
    rank = torch.arange(len(tile), device=of.device) - before[tile]
    return Partitions(sums=sums, tile=tile, rank=rank, nearest=nearest, place=_places(rows, own, tile, nearest, light), counts=counts)


def faint_rows(rows: Rows, light: TileLight, settings: Settings) -> Bool[Tensor, " rows"]:
    """Return which rows can hardly be seen, spread over the area of their filter; none of a tile where all are."""
    if not (settings.merge and settings.faint > 0.0):
        return torch.zeros_like(rows.tile, dtype=torch.bool)
    tiles = len(rows.first) - 1
    of_tiles = rows.light.new_zeros((tiles, 3)).index_add_(0, rows.tile, rows.light)
    typical = (of_tiles[:, 2] / of_tiles[:, 0]) ** 2
    sigma_u, sigma_v = blur_px(rows.sums, light.window, settings.sigma_x_px)
    most = settings.faint * light.per_pixel * 4.0 * math.pi * sigma_u * sigma_v
    faint = (rows.light[:, 0] <= most) & (rows.light[:, 1] <= most * typical[rows.tile])
    any_seen = torch.zeros(tiles, dtype=torch.int64, device=faint.device).index_add_(0, rows.tile, (~faint).long()) > 0
    return faint & any_seen[rows.tile]


def _by_slopes(
    rows: Rows,
    faint: Int64[Tensor, " faint"],
    sums: Float64[Tensor, "partitions 8"],
    counts: Int64[Tensor, " tiles"],
    light: TileLight,
    settings: Settings,
) -> Int64[Tensor, " faint"]:
    """Return the partition of its tile by whose slopes the mean sample of each of these rows goes least wrong."""
    tile, rank = rows.tile[faint], torch.arange(int(counts.max()), device=faint.device)
    of = ((torch.cumsum(counts, 0) - counts)[tile][:, None] + rank).clamp(max=len(sums) - 1)
    one = rows.sums[faint][:, None].expand(*of.shape, -1)
    distance = slope_distance(one, sums[of], light.window, settings.sigma_x_px)
    return torch.where(rank < counts[tile][:, None], distance, torch.inf).argmin(dim=1)


def merged_rows(rows: Rows, window: Float64[Tensor, "4"], settings: Settings) -> tuple[Int64[Tensor, " rows"], Int64[Tensor, " tiles"]]:
    """Return the partition of each row within its tile, and how many a tile has: a sweep over the rows of each tile.

    A row joins the last partition of which the common filter is hardly narrower than that of any part, and the slopes are alike.
    """
    if not settings.merge:
        return torch.arange(len(rows.tile), device=rows.tile.device) - rows.first[rows.tile], rows.first.diff()
    of_rows = torch.stack(extents(rows.sums, window, settings.sigma_x_px, settings.bandwidth), dim=-1)
    limits = settings.merge_tolerance * (WIDEST_PX / of_rows[:, 0].clamp(min=1e-6)).clamp(max=1.0)
    numbers = settings.sigma_x_px, settings.bandwidth, 1.0 - settings.merge_tolerance
    if of_rows.device.type == "cuda" and has_triton():
        from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._triton import sweep_by_kernel

        return sweep_by_kernel(rows, of_rows, limits, window, numbers, LOOK_BACK)
    return sweep_row_by_row(rows, of_rows, limits, window, numbers, LOOK_BACK)


def _places(
    rows: Rows, own: Int64[Tensor, " rows"], tile: Int64[Tensor, " partitions"], nearest: Int64[Tensor, " partitions"], light: TileLight
) -> Int64[Tensor, "tiles buckets"]:
    """Return the place of every bucket. Buckets that no row of the tile knows belong to a row beside
    them, in depth or motion, the foremost; else between partitions.
    """
    tiles = len(rows.first) - 1
    of = torch.where(rows.place >= 0, 2 * own[rows.place.clamp(min=0)], -1)
    padded = torch.cat([of, torch.full_like(of[:, :1], -1)], dim=1)
    place = of
    for beside in light.beside.unbind(dim=1):
        place = torch.where(place >= 0, place, padded[:, beside])
    begun = torch.zeros((tiles, light.buckets + 1), dtype=torch.int64, device=own.device)
    begun.index_put_((tile, torch.searchsorted(light.depth, nearest)), torch.ones_like(tile), accumulate=True)
    gaps = 2 * torch.cumsum(begun, dim=1)[:, : light.buckets] - 1
    return torch.where(place >= 0, place, gaps)


def sweep_row_by_row(
    rows: Rows,
    of_rows: Float64[Tensor, "rows 2"],
    limits: Float64[Tensor, " rows"],
    window: Float64[Tensor, "4"],
    numbers: tuple[float, float, float],
    look_back: int,
) -> tuple[Int64[Tensor, " rows"], Int64[Tensor, " tiles"]]:
    """Sweep the rows of tiles, one row of every tile at a time; waits once. of_rows: extents of each row by itself. limits: of the
    distance of slopes.

    numbers: sigma_x_px, bandwidth, the least share of extents.
    """
    lengths = rows.first.diff()
    longest_first = torch.argsort(lengths, descending=True, stable=True)
    state = _Sweep(rows=rows, of_rows=of_rows, limits=limits, window=window, numbers=numbers, order=longest_first, look_back=look_back)
    own = torch.empty_like(rows.tile)
    for step, active in enumerate(_active(lengths).tolist()):
        row = rows.first[longest_first[:active]] + step
        own[row] = state.joined(row)
    counts = torch.empty_like(lengths)
    counts[longest_first] = state.count
    return own, counts


def _active(lengths: Int64[Tensor, " tiles"]) -> Int64[Tensor, " steps"]:
    """Return how many tiles have more rows than 0, 1, 2 and so on."""
    return len(lengths) - torch.cumsum(torch.bincount(lengths), 0)[:-1]


class _Sweep:
    """Partitions as they grow: sums, widest extents and first row of each, tiles in the order of their lengths."""

    def __init__(
        self,
        rows: Rows,
        of_rows: Float64[Tensor, "rows 2"],
        limits: Float64[Tensor, " rows"],
        window: Float64[Tensor, "4"],
        numbers: tuple[float, float, float],
        order: Int64[Tensor, " tiles"],
        look_back: int,
    ) -> None:
        self.sums, self.extents, self.limits, self.window, self.numbers = rows.sums, of_rows, limits, window, numbers
        tiles, most = len(order), int(rows.first.diff().max())
        self.merged = rows.sums.new_zeros((tiles, most, 8))
        self.widest = rows.sums.new_zeros((tiles, most, 2))
        self.first_row = torch.zeros((tiles, most), dtype=torch.int64, device=order.device)
        self.count = torch.zeros_like(order)
        self.back = torch.arange(look_back, device=order.device)

    def joined(self, row: Int64[Tensor, " active"]) -> Int64[Tensor, " active"]:
        """Return the partition that the next row of each of the first tiles joins."""
        at = torch.arange(len(row), device=row.device)
        count = self.count[: len(row)]
        before = count[:, None] - 1 - self.back
        fits = (before >= 0) & self._fits(row, at[:, None], before.clamp(min=0))
        nearest = fits.long().argmax(dim=1)
        any_fits = fits.any(dim=1)
        own = torch.where(any_fits, count - 1 - nearest, count)
        self.merged[at, own] += self.sums[row]
        self.widest[at, own] = torch.maximum(self.widest[at, own], self.extents[row])
        self.first_row[at, own] = torch.where(any_fits, self.first_row[at, own], row)
        self.count[: len(row)] += ~any_fits
        return own

    def _fits(
        self, row: Int64[Tensor, " active"], at: Int64[Tensor, "active 1"], j: Int64[Tensor, "active back"]
    ) -> Bool[Tensor, "active back"]:
        (sigma_x_px, bandwidth, least), limit = self.numbers, self.limits[row][:, None]
        one = self.sums[row][:, None].expand(*j.shape, -1)
        both = self.merged[at, j] + one
        width = torch.stack(extents(both, self.window, sigma_x_px, bandwidth), dim=-1)
        wide = width >= least * torch.maximum(self.widest[at, j], self.extents[row][:, None])
        alike = slope_distance(self.sums[self.first_row[at, j]], both, self.window, sigma_x_px) <= limit
        return wide.all(dim=-1) & alike & (slope_distance(one, both, self.window, sigma_x_px) <= limit)
