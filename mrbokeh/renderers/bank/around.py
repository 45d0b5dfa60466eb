"""Which places of a bank each pixel of a picture lies between, and what share of its light each of them takes."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Int64

from mrbokeh.layering.psf_over_field import Plane
from mrbokeh.renderers.bank.lattice import BankLattice
from mrbokeh.renderers.bank.tables import Place


@dataclass(frozen=True)
class Around:
    """The anchors of the bank's places around each pixel, and how much of its light each takes. one: the bank has but one anchor."""

    anchors: Int64[np.ndarray, "height width 4"]
    shares: Float32[np.ndarray, "height width 4"]
    one: bool = False

    @classmethod
    def of(cls, lattice: BankLattice, place: Place, size: tuple[int, ...]) -> "Around":
        """For a picture of this height and width."""
        if lattice.anchors == 1:
            first = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
            return cls(np.broadcast_to(np.int64(0), (*size, 4)), np.broadcast_to(first, (*size, 4)), one=True)
        field_xy = np.zeros((*size, 2), np.float32) if place.field_xy is None else place.field_xy
        return cls(*lattice.field_shares(field_xy))

    def by_anchor(self) -> Iterator[tuple[int, Plane | None]]:
        """The anchors in use, and each pixel's share of them; None is all."""
        if self.one:
            yield 0, None
            return
        for anchor in np.unique(self.anchors[self.shares > 0]).tolist():
            yield anchor, np.where(self.anchors == anchor, self.shares, np.float32(0.0)).sum(axis=-1)
