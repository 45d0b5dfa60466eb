"""The kernels of a bank as sums of few separable ones."""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float64

from mrbokeh.renderers.bank.lattice import SIDES, BankLattice
from mrbokeh.renderers.kernels.low_rank_kernel import LowRankKernel
from mrbokeh.system.console import track

BankTerms = Mapping[tuple[int, int, int, int], LowRankKernel]
"""By side of the focus, node, place and channel (see BankLattice); each states what it misses of its kernel."""


def decompose_bank(lattice: BankLattice, decomposed: Callable[[Float64[np.ndarray, "size size"]], LowRankKernel]) -> BankTerms:
    """All kernels, as behind the focus. decomposed: how, see LowRankFilter."""
    nodes = [(side, node, place) for side in SIDES for node in range(len(lattice.diameters_px[side])) for place in range(lattice.places)]
    terms = {}
    for key in track(nodes, "low-rank terms of the bank"):
        kernel = lattice.kernel(*key)
        for channel in range(lattice.bank.channels):
            terms[(*key, channel)] = decomposed(np.ascontiguousarray(kernel[..., channel]))
    return terms
