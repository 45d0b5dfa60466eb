"""A place of a bank in the role of an Aperture: its kernels at any diameter, blended between those that the bank has."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.optics.psf import Psf
from mrbokeh.renderers.bank.low_rank_levels import Levels
from mrbokeh.renderers.bank.low_rank_terms import BankTerms
from mrbokeh.renderers.bank.spread import AnchorKernels
from mrbokeh.renderers.kernels.low_rank_kernel import LowRankKernel
from mrbokeh.renderers.kernels.polygon_fit import grown

Decompose = Callable[[Float64[np.ndarray, "size size"]], LowRankKernel]


@dataclass(frozen=True, eq=False)
class KernelOpening:
    """Of one side of the focus, seen as behind it, one channel of the kernels.

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
        """Behind the focus where positive, turned by half a turn where negative."""
        lower, upper = (each.item() for each in self.kernels.lattice.diameter_shares(self.side, np.array(abs(diameter_px))))
        parts = [(lower, 1.0 - upper), (lower + 1, upper)]
        found = [(self._at(node), share) for node, share in parts if share > 0.0]
        size = max(len(kernel) for kernel, _ in found)
        kernel = np.sum([share * grown(each, size) for each, share in found], axis=0)
        return Psf(np.ascontiguousarray(kernel if diameter_px > 0 else kernel[::-1, ::-1]))

    def levels(self, diameters_px: Float32[np.ndarray, "height width"], exact: Float32[np.ndarray, "height width"]) -> Levels:
        """The bank's own diameters as levels; `diameters_px` is 0 for pixels that take no part."""
        from mrbokeh.renderers.bank._low_rank_pixels_numba import NOT_A_LEVEL

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
        """The terms of one of the bank's own diameters."""
        node = int(np.argmin(np.abs(self.kernels.lattice.diameters_px[self.side] - diameter_px)))
        place, angle_rad = self.kernels.lattice.place_and_angle(self.anchor)
        known = None if angle_rad else self.terms.get((self.side, node, place, self.channel))
        key = self.side, node, self.anchor, self.channel
        if known is None and key not in self.kept:
            self.kept[key] = decomposed(self._at(node))
        return known or self.kept[key]

    def _at(self, node: int) -> Float64[np.ndarray, "size size"]:
        return np.ascontiguousarray(self.kernels.kernel(self.side, node, self.anchor)[..., self.channel])
