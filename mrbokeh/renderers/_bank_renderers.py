"""A bank of kernels behind the renderers that spread one side of the focus, or one opening, at a time."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from mrbokeh.aperture import Aperture
from mrbokeh.bank_apertures import BankApertures
from mrbokeh.bank_low_rank import BankTerms
from mrbokeh.layer import Layer
from mrbokeh.layering import Layering, render_layers
from mrbokeh.lens import Lens
from mrbokeh.low_rank import LowRankKernel
from mrbokeh.optics import Channels, Plane
from mrbokeh.psf_bank import PsfBank
from mrbokeh.renderers._bank_around import Around
from mrbokeh.renderers._bank_by_aperture import TurnedApertures, spread_shares
from mrbokeh.renderers._bank_opening import KernelOpening
from mrbokeh.renderers._bank_scatter import scatter_side
from mrbokeh.renderers._bank_spread import AnchorKernels, BlendedTables, SpreadSide, spread_by_bank
from mrbokeh.renderers._laplacian_bank import Place
from mrbokeh.renderers._laplacian_layers import BankOptics

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
