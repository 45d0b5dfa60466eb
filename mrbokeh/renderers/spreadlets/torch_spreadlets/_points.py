"""Points of kernels on a device: those of one call, or those of a bank, which are kept and grow with what pictures ask for."""

from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float64, Int32, Int64
from torch import Tensor

from mrbokeh.renderers.bank.tables import BankTables
from mrbokeh.renderers.kernels.laplacian_tables import Points

_REACH_STEP_PX = 16
_LARGEST_SUM = 64.0  # far above the 8 that banks were seen to have, so that units do not depend on what was asked for before


@dataclass(frozen=True)
class PointTable:
    """xy (N, 2) right and down of the source; weights (N, K), one column for each colour; cell i has count[i] points from first[i].

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
    """The points of the CPU's renderer on a device."""
    count, weights = np.diff(points.starts), points.weights[:, None]
    largest = _largest_at(np.zeros((2 * points.reach_px + 1,) * 2), points.xy, weights)
    xy, values, first, counts = _on(device, points.xy, weights, points.starts[:-1].astype(np.int32), count.astype(np.int32))
    return PointTable(xy, values, first, counts, int(count.max()), points.reach_px, float(largest.sum()))


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
        """A table whose cells are all codes of the bank; these have their points. Its reach is rounded up, so as to change rarely."""
        new = codes[self._count[codes] == 0]
        if new.size:
            self._add(new)
        reach_px = -(-int(self._reach_px[codes].max()) // _REACH_STEP_PX) * _REACH_STEP_PX
        first, count = self._on_device
        largest_sum = max(_LARGEST_SUM, float(self._largest.sum()))
        return PointTable(self._xy, self._weights, first, count, int(self._count[codes].max()), reach_px, largest_sum)

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
    """For every offset the largest weight, without sign, of any kernel there; added to what is known."""
    middle = len(largest) // 2
    np.maximum.at(largest, (xy[:, 1] + middle, xy[:, 0] + middle), np.abs(weights).max(axis=1))
    return largest


def _on(device: torch.device, *arrays: np.ndarray) -> list[Tensor]:
    return [torch.from_numpy(np.ascontiguousarray(array)).to(device, copy=True) for array in arrays]
