"""Renderers by a bank of kernels: for a method that sums one side of the focus, or one opening, at a time.

A place of a bank takes the role of an Aperture (`KernelOpening`): its kernels at any diameter, blended between those of the bank,
and as sums of few separable ones for low-rank filters.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.images.layer import Layer
from mrbokeh.layering.layering import Layering, render_layers
from mrbokeh.layering.psf_over_field import Channels, Plane
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf import Psf
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.bank.apertures import BankApertures, TurnedApertures, grown
from mrbokeh.renderers.bank.bank_psf import BankPsf
from mrbokeh.renderers.bank.blending import AnchorKernels, BlendedTables, SideSum, blend_colours, scatter_side, sum_openings
from mrbokeh.renderers.bank.lattice import SIDES, Around, BankLattice
from mrbokeh.renderers.bank.tables import Place
from mrbokeh.renderers.kernels.low_rank_kernel import Levels, LowRankKernel
from mrbokeh.system.console import track

BankTerms = Mapping[tuple[int, int, int, int], LowRankKernel]
"""By side of the focus, node, place and channel (see BankLattice); each states what it misses of its kernel."""


def decompose_bank(lattice: BankLattice, decomposed: Callable[[Float64[np.ndarray, "size size"]], LowRankKernel]) -> BankTerms:
    """Decompose all kernels, as behind the focus. decomposed: one kernel's terms, see LowRankFilter."""
    nodes = [(side, node, place) for side in SIDES for node in range(len(lattice.diameters_px[side])) for place in range(lattice.places)]
    terms = {}
    for key in track(nodes, "low-rank terms of the bank"):
        kernel = lattice.kernel(*key)
        for channel in range(lattice.bank.channels):
            terms[(*key, channel)] = decomposed(np.ascontiguousarray(kernel[..., channel]))
    return terms


Decompose = Callable[[Float64[np.ndarray, "size size"]], LowRankKernel]


@dataclass(frozen=True, eq=False)
class KernelOpening:
    """Opening of one side of the focus, seen as behind it, by one channel of the kernels.

    terms: low-rank terms that are known already; kept: those that were found since, for all openings of a bank.
    """

    kernels: AnchorKernels
    side: int
    anchor: int
    channel: int
    terms: BankTerms
    kept: dict[tuple[int, int, int, int], LowRankKernel]

    @property
    def unit_radius(self) -> float:
        return self.kernels.unit_radius

    def rasterize(self, diameter_px: float) -> Psf:
        """Draw the kernel: as behind the focus if the diameter is positive, turned by half a turn if it is negative."""
        lower, upper = (each.item() for each in self.kernels.lattice.diameter_shares(self.side, np.array(abs(diameter_px))))
        parts = [(lower, 1.0 - upper), (lower + 1, upper)]
        found = [(self._at(node), share) for node, share in parts if share > 0.0]
        size = max(len(kernel) for kernel, _ in found)
        kernel = np.sum([share * grown(each, size) for each, share in found], axis=0)
        return Psf(np.ascontiguousarray(kernel if diameter_px > 0 else kernel[::-1, ::-1]))

    def levels(self, diameters_px: Float32[np.ndarray, "height width"], exact: Float32[np.ndarray, "height width"]) -> Levels:
        """Sort pixels into the bank's own diameters as levels; `diameters_px` is 0 for pixels that take no part."""
        from mrbokeh.renderers.kernels._low_rank_numba import NOT_A_LEVEL

        nodes_px = self.kernels.lattice.diameters_px[self.side]
        lower, upper = self.kernels.lattice.diameter_shares(self.side, diameters_px)
        live = (diameters_px > 0) & (exact < 1.0)
        used = np.zeros(len(nodes_px), bool)
        used[lower[live & (upper < 1.0)]] = True
        used[lower[live & (upper > 0.0)] + 1] = True
        first, last = np.flatnonzero(used)[[0, -1]]
        level = np.where(upper < 1.0, lower, lower + 1) - first
        steps_px = np.where(used, nodes_px, np.nan)[first : last + 1]
        share = np.where(live & (upper < 1.0), upper, 0.0).astype(np.float32)
        return Levels(tuple(steps_px.tolist()), np.where(live, level, NOT_A_LEVEL).astype(np.int16), share)

    def low_rank(self, diameter_px: float, decomposed: Decompose) -> LowRankKernel:
        """Return the terms of one of the bank's own diameters."""
        node = int(np.argmin(np.abs(self.kernels.lattice.diameters_px[self.side] - diameter_px)))
        place, angle_rad = self.kernels.lattice.place_and_angle(self.anchor)
        known = None if angle_rad else self.terms.get((self.side, node, place, self.channel))
        key = self.side, node, self.anchor, self.channel
        if known is None and key not in self.kept:
            self.kept[key] = decomposed(self._at(node))
        return known or self.kept[key]

    def _at(self, node: int) -> Float64[np.ndarray, "size size"]:
        return np.ascontiguousarray(self.kernels.kernel(self.side, node, self.anchor)[..., self.channel])


Inner = Callable[[Channels, Plane, Any], Channels]


@dataclass(frozen=True, eq=False)
class BankRenderer:
    """Rendering by a bank in place of the lens's aperture."""

    tables: BlendedTables
    sum_side: SideSum

    def render(self, layers: Sequence[Layer], lens: Lens, layering: Layering) -> Layer:
        return render_layers(layers, lens, BankPsf.of(layers, lens, self.tables, self.sum_bank_kernels), layering)

    def sum_bank_kernels(self, values: Channels, coc_px: Plane, place: Place) -> Channels:
        return blend_colours(self.tables, self.sum_side, values, coc_px, place)


def by_scatter(bank: PsfBank) -> BankRenderer:
    """Make a renderer by the exact kernels, blended."""
    tables = BlendedTables(bank, None)
    return BankRenderer(tables, partial(scatter_side, AnchorKernels(tables.lattice)))


def by_polygons(bank: PsfBank, apertures: BankApertures, inner: Inner, prepare: Callable[[Aperture], object]) -> BankRenderer:
    """Make a renderer by polygons fitted to the kernels. inner: the kernel sum of one aperture; prepare: makes its tables."""
    tables = BlendedTables(bank, None, unit_radius=apertures.unit_radius)
    return BankRenderer(tables, _ByPolygons(TurnedApertures(tables.lattice, apertures, prepare), inner))


def by_low_rank(bank: PsfBank, terms: BankTerms | None, inner: Inner) -> BankRenderer:
    """Make a renderer by low-rank terms of the kernels; terms that are not given are found when they are needed."""
    tables = BlendedTables(bank, None)
    return BankRenderer(tables, _ByLowRank(AnchorKernels(tables.lattice), terms or {}, inner))


@dataclass(frozen=True, eq=False)
class _ByPolygons:
    apertures: TurnedApertures
    inner: Inner

    def __call__(self, values: Channels, coc_px: Plane, side: int, channel: int, around: Around) -> Channels:
        return sum_openings(values, coc_px, self.apertures.shares(coc_px, side, channel, around), self.inner)


@dataclass(frozen=True, eq=False)
class _ByLowRank:
    kernels: AnchorKernels
    terms: BankTerms
    inner: Inner
    kept: dict[tuple[int, int, int, int], LowRankKernel] = field(default_factory=dict)

    def __call__(self, values: Channels, coc_px: Plane, side: int, channel: int, around: Around) -> Channels:
        shares = (
            (share, KernelOpening(kernels=self.kernels, side=side, anchor=anchor, channel=channel, terms=self.terms, kept=self.kept))
            for anchor, share in around.by_anchor()
        )
        return sum_openings(values, coc_px, shares, self.inner)
