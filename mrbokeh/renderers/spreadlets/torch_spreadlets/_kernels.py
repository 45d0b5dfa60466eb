"""Kernels of a bank on a device: the one that each pixel takes (`BankTables.codes` and `stands_out` by torch), and their points.

Points are those of one call, or those of a bank, which are kept and grow with what pictures ask for.
"""

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int32, Int64
from torch import Tensor

from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.bank.tables import BankTables
from mrbokeh.renderers.kernels.laplacian_tables import AROUND_PX, OUTSHINES, Points
from mrbokeh.system.errors import InputError

Plane = Float32[Tensor, "height width"]
Way = Float32[Tensor, "height width 2"]


@dataclass
class BankCells:
    """The kernels of a bank by the code that `BankTables` gives them. dense: which cells go by all their taps.

    Whatever grid a bank has, the borders of its cells cut each axis into intervals, and each combination of intervals lies in
    one cell: finding it is a search among some hundred borders and one look-up. A pixel that lies, to rounding, on the border of
    two cells may take either.
    """

    tables: BankTables
    device: torch.device
    dense: Bool[np.ndarray, " cells"] = field(init=False, repr=False)
    _dense: Bool[Tensor, " cells"] = field(init=False, repr=False)
    _light: Float32[Tensor, "cells channels"] = field(init=False, repr=False)
    _borders: list[Float64[Tensor, " borders"]] = field(init=False, repr=False)
    _cell_at: Int64[Tensor, " intervals"] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        per_cell = 2 * self.tables.angles
        self.dense = np.array([self.tables.is_dense(cell * per_cell) for cell in range(len(self.tables.bank.kernels))])
        borders, cell_at = _intervals(self.tables.bank)
        self._borders = [torch.from_numpy(each).to(self.device) for each in borders]
        arrays = self.dense, self.tables.bank.throughput.astype(np.float32), cell_at
        self._dense, self._light, self._cell_at = (torch.from_numpy(array).to(self.device) for array in arrays)

    def codes(
        self, bright: Bool[Tensor, "height width"], coc_px: Plane, motion_px: Way | None, field_xy: Way | None, depth_m: Plane | None
    ) -> Int64[Tensor, "height width"]:
        """Return codes as `BankTables.codes` does."""
        bank, angles = self.tables.bank, self.tables.angles
        right, down = (None, None) if field_xy is None else (field_xy[..., 0], field_xy[..., 1])
        planes = {"diameter_px": coc_px, "motion_px": _length(motion_px), "depth_m": depth_m}
        planes |= {"eccentricity": _length(field_xy), "field_x": right, "field_y": down}
        place = torch.zeros_like(coc_px, dtype=torch.int64)
        for axis, borders in zip(bank.axes, self._borders, strict=True):
            plane = self._needed(planes[axis.name], axis.name).double()
            value = plane.abs() if axis.name == "diameter_px" and not axis.is_signed else plane
            place = place * (len(borders) + 1) + torch.searchsorted(borders, value.contiguous(), right=True)
        turn = torch.zeros_like(place)
        if bank.turns != "none":
            way = self._needed(motion_px if bank.turns == "motion" else field_xy, bank.turns)
            turn = torch.round(torch.atan2(way[..., 1], way[..., 0]) * angles / (2.0 * torch.pi)).long()
        if bank.near_side_turned:
            turn = turn + torch.where(coc_px < 0, angles // 2, 0)
        return 2 * (self._cell_at[place] * angles + turn % angles) + bright

    def light(self, codes: Int64[Tensor, "height width"]) -> Float32[Tensor, "height width channels"]:
        """Return the sum of each code's kernel."""
        return self._light[codes // 2 // self.tables.angles]

    def is_dense(self, codes: Int64[Tensor, "height width"]) -> Bool[Tensor, "height width"]:
        """Return what `BankTables.is_dense` does, for every pixel."""
        return self._dense[codes // 2 // self.tables.angles]

    def _needed(self, plane: Tensor | None, what: str) -> Tensor:
        if plane is None:
            raise InputError(
                f"the bank '{self.tables.bank.model}' needs {what} for every pixel, but none came: give it or take another bank"
            )
        return plane


def stands_out(values: Float32[Tensor, "height width channels"]) -> Bool[Tensor, "height width"]:
    """Return the mask of `mrbokeh.renderers.kernels.laplacian_tables.stands_out`."""
    light = values.abs().permute(2, 0, 1).double()
    rows, columns = (_mirrored(size, values.device) for size in values.shape[:2])
    side = 2 * AROUND_PX + 1
    across = torch.nn.functional.avg_pool2d(light[:, :, columns], (1, side), stride=1)
    around = torch.nn.functional.avg_pool2d(across[:, rows], (side, 1), stride=1)
    return (light > OUTSHINES * around).any(dim=0)


@lru_cache(maxsize=8)
def _mirrored(size: int, device: torch.device) -> Int64[Tensor, " around"]:
    """Return numbers of the pixels along an axis that goes on as in a mirror."""
    return torch.from_numpy(np.pad(np.arange(size), AROUND_PX, mode="reflect")).to(device)


def _length(way: Way | None) -> Plane | None:
    return None if way is None else torch.hypot(way[..., 0], way[..., 1])


def _intervals(bank: PsfBank) -> tuple[list[Float64[np.ndarray, " borders"]], Int64[np.ndarray, " intervals"]]:
    """Return inner borders on each axis, in physical coordinates, and the cell of every combination of intervals, the last axis
    fastest.
    """
    ends = [np.unique(bank.grid.boxes[:, axis]) for axis in range(len(bank.axes))]
    middles = np.meshgrid(*(0.5 * (each[:-1] + each[1:]) for each in ends), indexing="ij")
    cell_at = bank.grid.index_of(np.stack(middles, axis=-1)).reshape(-1)
    return [axis.from_unit(each[1:-1]) for axis, each in zip(bank.axes, ends, strict=True)], cell_at


_REACH_STEP_PX = 16
_LARGEST_SUM = 64.0  # far above the 8 that banks were seen to have, so that units do not depend on what was asked for before


@dataclass(frozen=True)
class PointTable:
    """Points of kernels: xy (N, 2) right and down of the source; weights (N, K), one column for each colour; cell i
    has count[i] points from first[i].

    most: the largest count. reach_px: no point lies farther away. largest_sum: no sum of points times light, one of them from
    every pixel around, exceeds this times the brightest light.
    """

    xy: Int32[Tensor, "points 2"]
    weights: Float64[Tensor, "points columns"]
    first: Int32[Tensor, " cells"]
    count: Int32[Tensor, " cells"]
    most: int
    reach_px: int
    largest_sum: float


def table_of(points: Points, device: torch.device) -> PointTable:
    """Return the points of the CPU's renderer on a device."""
    count, weights = np.diff(points.starts), points.weights[:, None]
    largest = _largest_at(np.zeros((2 * points.reach_px + 1,) * 2), points.xy, weights)
    xy, values, first, counts = _on(device, points.xy, weights, points.starts[:-1].astype(np.int32), count.astype(np.int32))
    return PointTable(
        xy=xy, weights=values, first=first, count=counts, most=int(count.max()), reach_px=points.reach_px, largest_sum=float(largest.sum())
    )


@dataclass
class BankPoints:
    """The points of a bank's codes, all taps (dense) or Laplacians; computed when first asked for, then kept on the device."""

    tables: BankTables
    dense: bool
    device: torch.device
    _first: Int32[np.ndarray, " codes"] = field(init=False, repr=False)
    _count: Int32[np.ndarray, " codes"] = field(init=False, repr=False)
    _reach_px: Int32[np.ndarray, " codes"] = field(init=False, repr=False)
    _largest: Float64[np.ndarray, "side side"] = field(init=False, repr=False)
    _xy: Int32[Tensor, "points 2"] = field(init=False, repr=False)
    _weights: Float64[Tensor, "points columns"] = field(init=False, repr=False)
    _on_device: list[Tensor] = field(init=False, repr=False, default_factory=list)

    def __post_init__(self) -> None:
        codes = 2 * self.tables.angles * len(self.tables.bank.kernels)
        self._first, self._count, self._reach_px = (np.zeros(codes, np.int32) for _ in range(3))
        self._largest = np.zeros((1, 1))
        self._xy, self._weights = _on(self.device, np.zeros((0, 2), np.int32), np.zeros((0, self.tables.bank.channels)))

    def of(self, codes: Int64[np.ndarray, " codes"]) -> PointTable:
        """Return a table whose cells are all codes of the bank; these have their points. Its reach is rounded up, so as to change
        rarely.
        """
        new = codes[self._count[codes] == 0]
        if new.size:
            self._add(new)
        reach_px = -(-int(self._reach_px[codes].max()) // _REACH_STEP_PX) * _REACH_STEP_PX
        first, count = self._on_device
        largest_sum = max(_LARGEST_SUM, float(self._largest.sum()))
        return PointTable(
            xy=self._xy,
            weights=self._weights,
            first=first,
            count=count,
            most=int(self._count[codes].max()),
            reach_px=reach_px,
            largest_sum=largest_sum,
        )

    def _add(self, codes: Int64[np.ndarray, " codes"]) -> None:
        parts = [self.tables.points(codes.tolist(), self.dense, channel) for channel in range(self._weights.shape[1])]
        points, weights = parts[0], np.stack([part.weights for part in parts], axis=1)
        self._first[codes] = points.starts[:-1] + len(self._xy)
        self._count[codes] = np.diff(points.starts)
        self._reach_px[codes] = np.maximum.reduceat(np.abs(points.xy).max(axis=1), points.starts[:-1])
        wider = max(0, points.reach_px - len(self._largest) // 2)
        self._largest = _largest_at(np.pad(self._largest, wider), points.xy, weights)
        xy_on, weights_on = _on(self.device, points.xy, weights)
        self._xy, self._weights = torch.cat([self._xy, xy_on]), torch.cat([self._weights, weights_on])
        self._on_device = _on(self.device, self._first, self._count)


def _largest_at(
    largest: Float64[np.ndarray, "side side"], xy: Int32[np.ndarray, "points 2"], weights: Float64[np.ndarray, "points columns"]
) -> Float64[np.ndarray, "side side"]:
    """Raise the known largest weights, by offset and without sign, to those of these kernels."""
    middle = len(largest) // 2
    np.maximum.at(largest, (xy[:, 1] + middle, xy[:, 0] + middle), np.abs(weights).max(axis=1))
    return largest


def _on(device: torch.device, *arrays: np.ndarray) -> list[Tensor]:
    return [torch.from_numpy(np.ascontiguousarray(array)).to(device, copy=True) for array in arrays]
