"""The sweep over the rows of tiles: one row of every tile at a time."""

import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._filter import extents, slope_distance
from mrbokeh.renderers.layered_reconstruction.torch_reconstruction._statistics import Rows


def sweep_row_by_row(
    rows: Rows,
    of_rows: Float64[Tensor, "rows 2"],
    limits: Float64[Tensor, " rows"],
    window: Float64[Tensor, "4"],
    numbers: tuple[float, float, float],
    look_back: int,
) -> tuple[Int64[Tensor, " rows"], Int64[Tensor, " tiles"]]:
    """One row of every tile at a time; waits once. of_rows: extents of each row by itself. limits: of the distance of slopes.

    numbers: sigma_x_px, bandwidth, the least share of extents.
    """
    lengths = rows.first.diff()
    longest_first = torch.argsort(lengths, descending=True, stable=True)
    state = _Sweep(rows, of_rows, limits, window, numbers, longest_first, look_back)
    own = torch.empty_like(rows.tile)
    for step, active in enumerate(_active(lengths).tolist()):
        row = rows.first[longest_first[:active]] + step
        own[row] = state.joined(row)
    counts = torch.empty_like(lengths)
    counts[longest_first] = state.count
    return own, counts


def _active(lengths: Int64[Tensor, " tiles"]) -> Int64[Tensor, " steps"]:
    """How many tiles have more rows than 0, 1, 2 and so on."""
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
        """The partition that the next row of each of the first tiles joins."""
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
