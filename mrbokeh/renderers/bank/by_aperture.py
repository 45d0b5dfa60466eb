"""A side of the focus of a bank through any Spread: shares of light by place and diameter, each with an opening of its own."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from threading import Lock
from typing import Any

import numpy as np

from mrbokeh.layering.psf_over_field import Channels, Plane
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.psf import kernel_radius_px
from mrbokeh.renderers.bank.apertures import BankApertures
from mrbokeh.renderers.bank.around import Around
from mrbokeh.renderers.bank.lattice import SIDES, BankLattice
from mrbokeh.renderers.bank.spread import not_black

SHARP_PX = 1.0

Shares = Iterator[tuple[Plane | None, Any]]
"""How much of each pixel's light an opening takes, and the opening; None is all, for the only opening there is."""


def spread_shares(values: Channels, coc_px: Plane, shares: Shares, spread: Callable[..., Channels]) -> Channels:
    """What is sharp, and every share spread within the window that its light reaches."""
    blurred = not_black(values) & (np.abs(coc_px) > SHARP_PX)
    total = np.where(blurred[..., None], np.float32(0.0), values)
    for share, opening in shares:
        if share is None:
            return spread(np.ascontiguousarray(values), coc_px, opening)
        mine = blurred & (share > 0)
        rows, columns = np.flatnonzero(mine.any(axis=1)), np.flatnonzero(mine.any(axis=0))
        if not rows.size:
            continue
        reach = kernel_radius_px(float(np.abs(coc_px[mine]).max()), opening.unit_radius)
        ends = ((each[0], each[-1] + 1, length) for each, length in zip((rows, columns), mine.shape, strict=True))
        window = tuple(slice(max(0, first - reach), min(length, stop + reach)) for first, stop, length in ends)
        part = values[window] * np.where(mine[window], share[window], np.float32(0.0))[..., None]
        total[window] += spread(np.ascontiguousarray(part), np.ascontiguousarray(coc_px[window]), opening)
    return total


@dataclass(frozen=True, eq=False)
class TurnedApertures:
    """The apertures of a bank turned to where they are used, kept: renderers keep tables for each as long as it lives.

    prepare: makes those tables, once for each although slices are spread at the same time.
    """

    lattice: BankLattice
    apertures: BankApertures
    prepare: Callable[[Aperture], object]
    _kept: dict[tuple[int, float], Aperture] = field(default_factory=dict, repr=False)
    _preparing: Lock = field(default_factory=Lock, repr=False)

    def shares(self, coc_px: Plane, side: int, channel: int, around: Around) -> Shares:
        """One for each opening that some pixel takes: places and diameters that share an aperture are one."""
        if self.apertures.is_one(side, channel) and self.lattice.directions == 1:
            yield None, self._aperture(side, 0, 0, channel)
            return
        taken: dict[int, tuple[Plane, Aperture]] = {}
        of_nodes = list(self._by_node(coc_px, side))
        for anchor, share in around.by_anchor():
            for node, of_node in of_nodes:
                mine = of_node if share is None else share * of_node
                if (mine > 0).any():
                    opening = self._aperture(side, node, anchor, channel)
                    before = taken.get(id(opening))
                    taken[id(opening)] = (mine if before is None else before[0] + mine, opening)
        yield from taken.values()

    def _by_node(self, coc_px: Plane, side: int) -> Iterator[tuple[int, Plane]]:
        """The fitted diameters in use, and each pixel's share of them; sharp pixels have none."""
        lower, upper = self.apertures.shares(side, np.abs(coc_px))
        live = np.abs(coc_px) > SHARP_PX
        for node in range(len(self.apertures.diameters_px[SIDES.index(side)])):
            of_node = live * np.where(lower == node, 1.0 - upper, np.where(lower + 1 == node, upper, 0.0)).astype(np.float32)
            if of_node.any():
                yield node, of_node

    def _aperture(self, side: int, node: int, anchor: int, channel: int) -> Aperture:
        place, angle_rad = self.lattice.place_and_angle(anchor)
        upright = self.apertures.apertures[SIDES.index(side)][node][place][channel]
        key = id(upright), angle_rad
        with self._preparing:
            if key not in self._kept:
                aperture = upright.rotated(angle_rad)
                self.prepare(aperture)
                self._kept[key] = aperture
            return self._kept[key]
