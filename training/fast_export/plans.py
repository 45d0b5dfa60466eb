"""What may be made faster in a network, from the boldest plan to one that changes nothing."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from onnx import ModelProto

from mrbokeh.errors import InputError
from training.fast_export.coarse_kernels import taps_radius
from training.fast_export.gated_graph import GatedGraph
from training.fast_export.published_graph import BlockPlan, PublishedGraph, blocks_of, kernels_of
from training.fast_export.separable import piece_px, separable_kernels
from training.gated_network import GatedTiles
from training.network import BlurNetwork
from training.published_tiles import PublishedTiles, ResidualBlock

FACTORS = (4, 2, 1)
LEAST_PIXELS = (3.0, 4.0, 5.0, 6.5, 8.5, 11.0, 15.0, 20.0, 27.0, float("inf"))
SMALL_ERROR = 0.02  # of a separable kernel, norm over norm
_MATRIX_OVER_CONVOLUTION = 0.5  # measured on Zen 5: multiplications a second of MatMul with its copies, over those of a blocked Conv


@dataclass(frozen=True)
class Plan:
    """least_pixels: so many coarse pixels a kernel is wide, at least. factors: for n = 1, 2, ...; ranks: likewise, None is not separable.

    reach_px: how far from a pixel the graph looks.
    """

    least_pixels: float
    factors: tuple[int, ...]
    ranks: tuple[int | None, ...]
    reach_px: int

    def to_json(self) -> dict[str, Any]:
        return {"factors": list(self.factors), "ranks": list(self.ranks)}

    def words(self) -> str:
        """One line for people."""
        shares = [f"{self.factors.count(factor)} at 1/{factor}" for factor in sorted(set(self.factors))]
        ranks = sorted(rank for rank in self.ranks if rank is not None)
        low_rank = f"{len(ranks)} separable of rank {ranks[0]} to {ranks[-1]}" if ranks else "none separable"
        return f"kernel sizes by resolution: {', '.join(shares)}; {low_rank}"


def plans(network: BlurNetwork) -> Iterator[Plan]:
    """Boldest first. Large kernels go to coarse pixels as long as they are still `least_pixels` of them wide."""
    tiles = network.tiles
    if isinstance(tiles, GatedTiles) and network.grid is not None:
        raise InputError(
            "a fast export of the gated form needs a network without tiles: train with tile_px 0 (field_bases learn the field)"
        )
    if not isinstance(tiles, GatedTiles | PublishedTiles):
        raise InputError("a fast export is there for the published and the gated form only: export without --fast")
    if isinstance(tiles, GatedTiles):
        radii = list(range(1, len(tiles.kernels) + 1))
        whole_ranks: list[int | None] = [None] * len(radii)
    else:
        radii = [block.radius for block in blocks_of(tiles)]
        whole_ranks = [_rank(block) for block in blocks_of(tiles)]
    for least in LEAST_PIXELS:
        factors = tuple(next((factor for factor in FACTORS if (2 * n + 1) / factor >= least), 1) for n in radii)
        if isinstance(tiles, GatedTiles):
            reach = max(n if factor == 1 else factor * (taps_radius(n, factor) + 1) for n, factor in zip(radii, factors, strict=True))
            yield Plan(least, factors, (None,) * len(factors), reach)
        else:
            ranks = tuple(rank if factor == 1 else None for rank, factor in zip(whole_ranks, factors, strict=True))
            coarse_margin = sum(4 * factor for factor in factors if factor > 1)
            yield Plan(least, factors, ranks if least < np.inf else (None,) * len(factors), network.reach_px + coarse_margin)


def model_of(network: BlurNetwork, plan: Plan) -> ModelProto:
    if isinstance(network.tiles, GatedTiles):
        return GatedGraph(network, dict(enumerate(plan.factors, start=1))).model()
    return PublishedGraph(network, [BlockPlan(*each) for each in zip(plan.factors, plan.ranks, strict=True)]).model()


def _rank(block: ResidualBlock) -> int | None:
    """The smallest rank that misses little of both convolutions of a block, where it takes less time than they do."""
    n = block.radius
    worth = int(_MATRIX_OVER_CONVOLUTION * (2 * n + 1) ** 2 / (2 * (piece_px(n) + 2 * n)))
    both = [kernels_of(each, each.out_channels)[0] for each in (block.first, block.second)]
    for rank in range(1, worth + 1):
        if all(separable_kernels(kernels, rank).relative_error <= SMALL_ERROR for kernels in both):
            return rank
    return None
