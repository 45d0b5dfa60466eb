"""Lattice of a bank: its kernels over signed diameter and place in the frame, and those that each pixel lies between."""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
from jaxtyping import Float, Float32, Float64, Int64

from mrbokeh.layering.psf_over_field import Plane
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.bank.tables import Place
from mrbokeh.system.errors import InputError

SIDES = (1, -1)
"""Behind the focus and in front of it."""
ANGLES = 16
"""Directions from the middle of the frame in which kernels that turn with the field are used."""
_AXES = ("diameter_px", "eccentricity", "field_x", "field_y")


@dataclass(frozen=True, eq=False)
class BankLattice:
    """Nodes of a bank: (side of the focus, number of the diameter, number of the place); a pixel's kernel is blended from those around it.

    Places are the middles of the bank's cells over the field, and anchors are places turned: the same but for a bank that
    turns with the field, of which each place serves in `ANGLES` directions. Kernels are those of points behind the focus: what the
    bank has for points in front is turned by half a turn, as an Aperture is. They sum to 1; `light` is what they let through.
    """

    bank: PsfBank

    def __post_init__(self) -> None:
        names = [axis.name for axis in self.bank.axes]
        others = [name for name in names if name not in _AXES]
        if others or "diameter_px" not in names or self.bank.turns == "motion":
            raise InputError(
                f"expected a bank over diameter and place in the frame, got {', '.join(names)}: --renderer laplacian takes every bank"
            )
        if len(names) > 1 and (self.bank.knee_px is not None or self.bank.nested):
            raise InputError("a bank over diameter and place must lie on a regular grid: --renderer laplacian takes every bank")

    @cached_property
    def diameters_px(self) -> dict[int, Float64[np.ndarray, " nodes"]]:
        """Unsigned middles of the bank's cells on each side, ascending."""
        middles = self._middles("diameter_px")
        if middles[0] >= 0.0:
            return dict.fromkeys(SIDES, middles)
        return {side: np.sort(side * middles[side * middles > -1e-9]).clip(0.0) for side in SIDES}

    @cached_property
    def _field(self) -> tuple[Float64[np.ndarray, " columns"], Float64[np.ndarray, " rows"]]:
        """Middles of the cells right and down of the middle; or eccentricities and 0."""
        if self._is_polar:
            return self._middles("eccentricity"), np.zeros(1)
        return self._middles("field_x"), self._middles("field_y")

    @property
    def _is_polar(self) -> bool:
        return self.bank.turns == "field" or any(axis.name == "eccentricity" for axis in self.bank.axes)

    @property
    def directions(self) -> int:
        return ANGLES if self.bank.turns == "field" else 1

    @property
    def places(self) -> int:
        return len(self._field[0]) * len(self._field[1])

    @property
    def anchors(self) -> int:
        return self.places * self.directions

    def place_and_angle(self, anchor: int) -> tuple[int, float]:
        """Return the place of an anchor and the angle (radians, x towards y) by which its kernels are turned, in the picture."""
        place, direction = divmod(anchor, self.directions)
        return place, 2.0 * np.pi * direction / self.directions

    def diameter_shares(
        self, side: int, diameters_px: Float[np.ndarray, "*batch"]
    ) -> tuple[Int64[np.ndarray, "*batch"], Float64[np.ndarray, "*batch"]]:
        """Return the node below each unsigned diameter, and the share of the next one."""
        return between(self.diameters_px[side], diameters_px)

    def field_shares(
        self, field_xy: Float[np.ndarray, "*batch 2"]
    ) -> tuple[Int64[np.ndarray, "*batch 4"], Float32[np.ndarray, "*batch 4"]]:
        """Return the anchors around each position and their shares, which sum to 1; beyond the outermost places those count alone."""
        if not self._is_polar:
            (x, x_share), (y, y_share) = (between(self._field[i], field_xy[..., i]) for i in (0, 1))
            columns, rows = (len(each) for each in self._field)
            ends = [(np.minimum(y + j, rows - 1) * columns + np.minimum(x + i, columns - 1)) for j, i in product((0, 1), (0, 1))]
            return np.stack(ends, axis=-1), _bilinear(y_share, x_share)
        ring, ring_share = between(self._field[0], np.hypot(field_xy[..., 0], field_xy[..., 1]))
        turn = np.arctan2(field_xy[..., 1], field_xy[..., 0]) / (2.0 * np.pi) % 1.0 * self.directions
        first = np.floor(turn).astype(np.int64)
        rings = len(self._field[0])
        ends = [np.minimum(ring + j, rings - 1) * self.directions + (first + i) % self.directions for j, i in product((0, 1), (0, 1))]
        return np.stack(ends, axis=-1), _bilinear(ring_share, turn - first)

    def cell(self, side: int, node: int, place: int) -> int:
        """Return the number of the bank's cell."""
        column, row = place % len(self._field[0]), place // len(self._field[0])
        diameter_px = self.diameters_px[side][node]
        where = {"diameter_px": side * diameter_px, "eccentricity": self._field[0][column]}
        where |= {"field_x": self._field[0][column], "field_y": self._field[1][row]}
        return int(self.bank.nearest(np.array([where[axis.name] for axis in self.bank.axes], np.float64)))

    def kernel(self, side: int, node: int, place: int) -> Float64[np.ndarray, "size size channels"]:
        """Return the kernel as behind the focus, each channel with sum 1."""
        kernel = self.bank.kernels[self.cell(side, node, place)].astype(np.float64)
        turned = kernel[::-1, ::-1] if side < 0 and not self.bank.near_side_turned else kernel
        return np.ascontiguousarray(turned / turned.sum(axis=(0, 1)))

    def light(self, side: int) -> Float64[np.ndarray, "nodes places channels"]:
        """Return how much light the kernels let through."""
        return self._light[side]

    @cached_property
    def _light(self) -> dict[int, Float64[np.ndarray, "nodes places channels"]]:
        def of_side(side: int) -> Float64[np.ndarray, "nodes places channels"]:
            nodes = range(len(self.diameters_px[side]))
            return np.array([[self.bank.throughput[self.cell(side, node, place)] for place in range(self.places)] for node in nodes])

        return {side: of_side(side) for side in SIDES}

    def _middles(self, name: str) -> Float64[np.ndarray, " middles"]:
        """Return the middles of the bank's cells along one axis, ascending; 0 if it has no such axis."""
        at = [index for index, axis in enumerate(self.bank.axes) if axis.name == name]
        return np.unique(self.bank.centres[:, at[0]].round(9)) if at else np.zeros(1)


def between(
    nodes: Float64[np.ndarray, " nodes"], values: Float[np.ndarray, "*batch"]
) -> tuple[Int64[np.ndarray, "*batch"], Float64[np.ndarray, "*batch"]]:
    """Return the node below each value, and how far towards the next one it lies (0 to 1); beyond the ends it lies at them."""
    place = np.interp(values, nodes, np.arange(len(nodes)))
    lower = np.minimum(np.asarray(place).astype(np.int64), max(len(nodes) - 2, 0))
    return np.asarray(lower), np.asarray(place - lower)


def _bilinear(down: np.ndarray, across: np.ndarray) -> Float32[np.ndarray, "*batch 4"]:
    shares = [(1.0 - down) * (1.0 - across), (1.0 - down) * across, down * (1.0 - across), down * across]
    return np.stack(shares, axis=-1).astype(np.float32)


@dataclass(frozen=True)
class Around:
    """The anchors of the bank's places around each pixel, and how much of its light each takes. one: the bank has but one anchor."""

    anchors: Int64[np.ndarray, "height width 4"]
    shares: Float32[np.ndarray, "height width 4"]
    one: bool = False

    @classmethod
    def of(cls, lattice: BankLattice, place: Place, size: tuple[int, ...]) -> "Around":
        """Find the anchors for a picture of this height and width."""
        if lattice.anchors == 1:
            first = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
            return cls(np.broadcast_to(np.int64(0), (*size, 4)), np.broadcast_to(first, (*size, 4)), one=True)
        field_xy = np.zeros((*size, 2), np.float32) if place.field_xy is None else place.field_xy
        return cls(*lattice.field_shares(field_xy))

    def by_anchor(self) -> Iterator[tuple[int, Plane | None]]:
        """Yield the anchors in use, and each pixel's share of them; None is all."""
        if self.one:
            yield 0, None
            return
        for anchor in np.unique(self.anchors[self.shares > 0]).tolist():
            yield anchor, np.where(self.anchors == anchor, self.shares, np.float32(0.0)).sum(axis=-1)
