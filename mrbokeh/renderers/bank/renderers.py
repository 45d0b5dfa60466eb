"""A bank of kernels behind the renderers that spread one side of the focus, or one opening, at a time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from mrbokeh.images.layer import Layer
from mrbokeh.layering.layering import Layering, render_layers
from mrbokeh.layering.psf_over_field import Channels, Plane
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.optics.psf_bank import PsfBank
from mrbokeh.renderers.bank.apertures import BankApertures
from mrbokeh.renderers.bank.around import Around
from mrbokeh.renderers.bank.bank_optics import BankOptics
from mrbokeh.renderers.bank.by_aperture import TurnedApertures, spread_shares
from mrbokeh.renderers.bank.low_rank_terms import BankTerms
from mrbokeh.renderers.bank.opening import KernelOpening
from mrbokeh.renderers.bank.scatter import scatter_side
from mrbokeh.renderers.bank.spread import AnchorKernels, BlendedTables, SpreadSide, spread_by_bank
from mrbokeh.renderers.bank.tables import Place
from mrbokeh.renderers.kernels.low_rank_kernel import LowRankKernel

Inner = Callable[[Channels, Plane, Any], Channels]


@dataclass(frozen=True, eq=False)
class BankRenderer:
    """What a renderer does in place of spreading by the lens's aperture."""

    tables: BlendedTables
    spread_side: SpreadSide

    def render(self, layers: Sequence[Layer], lens: Lens, layering: Layering) -> Layer:
        return render_layers(layers, lens, BankOptics.of(layers, lens, self.tables, self.spread), layering)

    def spread(self, values: Channels, coc_px: Plane, place: Place) -> Channels:
        return spread_by_bank(self.tables, self.spread_side, values, coc_px, place)


def by_scatter(bank: PsfBank) -> BankRenderer:
    """With the exact kernels, blended."""
    tables = BlendedTables(bank, None)
    return BankRenderer(tables, partial(scatter_side, AnchorKernels(tables.lattice)))


def by_polygons(bank: PsfBank, apertures: BankApertures, inner: Inner, prepare: Callable[[Aperture], object]) -> BankRenderer:
    """With the polygons fitted to them. inner: the spread of one aperture; prepare: what it needs for each."""
    tables = BlendedTables(bank, None, unit_radius=apertures.unit_radius)
    return BankRenderer(tables, _ByPolygons(TurnedApertures(tables.lattice, apertures, prepare), inner))


def by_low_rank(bank: PsfBank, terms: BankTerms | None, inner: Inner) -> BankRenderer:
    """With their low-rank terms; those that are not given are found when they are needed."""
    tables = BlendedTables(bank, None)
    return BankRenderer(tables, _ByLowRank(AnchorKernels(tables.lattice), terms or {}, inner))


@dataclass(frozen=True, eq=False)
class _ByPolygons:
    apertures: TurnedApertures
    inner: Inner

    def __call__(self, values: Channels, coc_px: Plane, side: int, channel: int, around: Around) -> Channels:
        return spread_shares(values, coc_px, self.apertures.shares(coc_px, side, channel, around), self.inner)


@dataclass(frozen=True, eq=False)
class _ByLowRank:
    kernels: AnchorKernels
    terms: BankTerms
    inner: Inner
    kept: dict[tuple[int, int, int, int], LowRankKernel] = field(default_factory=dict)

    def __call__(self, values: Channels, coc_px: Plane, side: int, channel: int, around: Around) -> Channels:
        shares = (
            (share, KernelOpening(self.kernels, side, anchor, channel, self.terms, self.kept)) for anchor, share in around.by_anchor()
        )
        return spread_shares(values, coc_px, shares, self.inner)
