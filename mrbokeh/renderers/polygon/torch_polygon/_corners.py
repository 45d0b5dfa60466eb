"""Tables of polygonal differences on a device: corners, sums along directions with whole-number profiles, and whole small kernels."""

from dataclasses import dataclass
from fractions import Fraction
from math import lcm, log, pi
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float32, Int32
from torch import Tensor

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.polygon.directional_differences import edge_profile
from mrbokeh.renderers.polygon.tables import ApertureTables, small_kernels
from mrbokeh.system.errors import InputError

REACH_PX = 16
"""How far small kernels reach at most."""
_FINEST_PROFILE = 64
"""Largest denominator that a profile of few steps has."""
_LATTICE = 1.25
"""How much denser the corners of pixels may lie in a kernel than its area says."""


class Along(NamedTuple):
    """Sum along one direction: its step; the planes that feed it, each with a sign; its profile in whole numbers, (x, y, weight)."""

    step: tuple[int, int]
    inputs: list[tuple[int, int]]
    taps: list[tuple[int, int, int]]


@dataclass(frozen=True)
class DeviceTables:
    """An aperture's `ApertureTables` on one device.

    edges (E, 4): slope, shift, origin, curvature. corners (K, 7): the edge before, the one after, what one line on of either moves the
    crossing in x and y, the plane. weights (K,): of the impulses. sums, unit: sums along directions, whose profiles count in 1 / unit.
    small (2, levels + 1, size, size): whole kernels behind the focus and in front.
    taps (T, 4): number of the sum, x, y and weight of every entry of the profiles. directions (D, 2 + 2 I): x and y of each step, then
    every plane that feeds the sum and its sign, filled up with nothing.
    """

    tables: ApertureTables
    edges: Float32[Tensor, "edges 4"]
    corners: Int32[Tensor, "corners 7"]
    weights: Float32[Tensor, " corners"]
    sums: list[Along]
    unit: int
    small: Float32[Tensor, "2 levels size size"]
    taps: Int32[Tensor, "taps 4"]
    directions: Int32[Tensor, "directions _"]

    @classmethod
    def of(cls, tables: ApertureTables, aperture: Aperture, device: torch.device) -> "DeviceTables":
        if tables.exact.radius > REACH_PX:
            raise InputError(
                f"on a device kernels are splatted whole up to {REACH_PX} px around, but exact_below_px {tables.exact.from_px:g} asks for "
                f"{tables.exact.radius}: lower it, or leave the device out"
            )
        corners, crossed = tables.corners, tables.crossed
        edges = np.stack([corners.slope, corners.shift, corners.origin, corners.curvature], axis=1)
        steps = crossed.steps * np.where(crossed.turned, -1, 1)[..., None]
        table = np.column_stack([crossed.before, crossed.after, steps.reshape(-1, 4), crossed.plane])
        sums, unit = _sums(tables)
        taps = np.array([(which, *tap) for which, along in enumerate(sums) for tap in along.taps], np.int32)
        return cls(
            tables=tables,
            edges=torch.from_numpy(edges.astype(np.float32)).to(device),
            corners=torch.from_numpy(table.astype(np.int32)).to(device),
            weights=torch.from_numpy(crossed.weight.astype(np.float32)).to(device),
            sums=sums,
            unit=unit,
            small=torch.from_numpy(small_kernels(aperture, tables.exact.to_px)).to(device),
            taps=torch.from_numpy(taps).to(device),
            directions=torch.tensor(_steps_and_inputs(sums), dtype=torch.int32).to(device),
        )

    @property
    def planes(self) -> int:
        return len(self.tables.planes)

    def bound(self, least_px: float, largest_px: float) -> float:
        """Return how much light of pixels up to 1 can meet in one place, at most: as if each had just the diameter that reaches it."""
        least_px = max(least_px, self.tables.exact.from_px)
        growth = 1.0 + 2.0 * log(max(largest_px, least_px) / least_px)
        weights = self.tables.exact.weights
        peak = float(weights[weights > 0.0].sum()) / self.tables.corners.area[0]
        return _LATTICE * pi * self.tables.extent**2 * peak * growth + 1.0


def _sums(tables: ApertureTables) -> tuple[list[Along], int]:
    """Return the sums along all directions that have a run, and the unit of their profiles."""
    directions = sorted({direction for pair in tables.planes for direction in pair if direction[0]})
    profiles = [edge_profile(direction) for direction in directions]
    shares = [{at: Fraction(weight).limit_denominator(_FINEST_PROFILE) for at, weight in taps.items()} for taps in profiles]
    unit = lcm(*(share.denominator for taps in shares for share in taps.values()))
    found = []
    for direction, taps in zip(directions, shares, strict=True):
        run = 1 if direction[0] > 0 else -1
        inputs = [(plane, run if pair[1] == direction else -run) for pair, plane in tables.planes.items() if direction in pair]
        found.append(Along(direction, inputs, [(x, y, int(share * unit)) for (x, y), share in taps.items()]))
    return found, unit


def _steps_and_inputs(sums: list[Along]) -> list[list[int]]:
    most = max(len(along.inputs) for along in sums)
    return [[*along.step, *(n for fed in along.inputs for n in fed), *[0, 0] * (most - len(along.inputs))] for along in sums]
