"""Plans for a faster network, from the boldest one to one that changes nothing."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from onnx import ModelProto

from mrbokeh.system.errors import InputError
from training.export.gated_graph import gated_model
from training.export.gated_groups import cost, reach_px, shared
from training.export.gated_weights import thinned, weights_of
from training.export.published_graph import BlockPlan, PublishedGraph, blocks_of, kernels_of, piece_px, separable_kernels
from training.networks.gated_network import GatedTiles
from training.networks.network import BlurNetwork
from training.networks.published_network import PublishedTiles, ResidualBlock

FACTORS = (4, 2, 1)
LEAST_PIXELS = (3.0, 4.0, 5.0, 6.5, 8.5, 11.0, 15.0, 20.0, 27.0, float("inf"))
SPACINGS = (0.4, 0.3, 0.2, 0.16, 0.14, 0.12, 0.1, 0.05, 0.0)  # of bins, over their diameter
SMALL_ERROR = 0.02  # of a separable kernel, norm over norm
_MATRIX_OVER_CONVOLUTION = 0.5  # measured on Zen 5: multiplications a second of MatMul with its copies, over those of a blocked Conv


@dataclass(frozen=True)
class Plan:
    """A plan. least_pixels: the least width of a kernel in coarse pixels. factors, ranks: for n = 1, 2, ...; rank None is not separable.

    spacing: of the bins of the gated form, see `gated_weights.thinned`; bins: how many that leaves, 0 in the published form.
    reach_px: how far from a pixel the graph looks.
    """

    least_pixels: float
    factors: tuple[int, ...]
    ranks: tuple[int | None, ...]
    reach_px: int
    spacing: float = 0.0
    bins: int = 0

    def to_json(self) -> dict[str, Any]:
        return {"factors": list(self.factors), "ranks": list(self.ranks), "spacing": self.spacing, "bins": self.bins}

    def words(self) -> str:
        """Describe the plan in one line."""
        shares = [f"{self.factors.count(factor)} at 1/{factor}" for factor in sorted(set(self.factors))]
        ranks = sorted(rank for rank in self.ranks if rank is not None)
        low_rank = f"{len(ranks)} separable of rank {ranks[0]} to {ranks[-1]}" if ranks else "none separable"
        return f"kernel sizes by resolution: {', '.join(shares)}; {f'{self.bins} bins' if self.bins else low_rank}"


def plans(network: BlurNetwork) -> Sequence[Plan]:
    """Return the plans, boldest first. Large kernels move to coarse pixels while they stay at least `least_pixels` of them wide."""
    if isinstance(network.tiles, GatedTiles) and network.grid is not None:
        raise InputError(
            "a fast export of the gated form needs a network without tiles: train with tile_px 0 (field_bases learn the field)"
        )
    if isinstance(network.tiles, GatedTiles):
        return _gated_plans(network.tiles)
    if isinstance(network.tiles, PublishedTiles):
        return [_published_plan(network, network.tiles, least) for least in LEAST_PIXELS]
    raise InputError("a fast export is there for the published and the gated form only: export without --fast")


def _gated_plans(tiles: GatedTiles) -> list[Plan]:
    """Return every resolution with every number of bins, by cost; of equivalent ones the first."""
    found: dict[Hashable, tuple[float, Plan]] = {}
    sizes, whole = range(1, len(tiles.kernels) + 1), weights_of(tiles)
    for spacing in SPACINGS:
        weights = thinned(whole, spacing)
        for least in LEAST_PIXELS:
            factors = _factors(sizes, least)
            plan = Plan(
                least_pixels=least,
                factors=factors,
                ranks=(None,) * len(factors),
                reach_px=reach_px(weights, factors),
                spacing=spacing,
                bins=len(weights.knots_px),
            )
            found.setdefault((tuple(weights.knots_px), *shared(weights, factors)), (cost(weights, factors), plan))
    return [plan for _, plan in sorted(found.values(), key=lambda each: each[0])]


def _published_plan(network: BlurNetwork, tiles: PublishedTiles, least: float) -> Plan:
    factors = _factors([block.radius for block in blocks_of(tiles)], least)
    ranks = tuple(_rank(block) if factor == 1 and least < np.inf else None for block, factor in zip(blocks_of(tiles), factors, strict=True))
    return Plan(least, factors, ranks, network.reach_px + sum(4 * factor for factor in factors if factor > 1))


def _factors(radii: Sequence[int], least_pixels: float) -> tuple[int, ...]:
    return tuple(next((factor for factor in FACTORS if (2 * n + 1) / factor >= least_pixels), 1) for n in radii)


def model_of(network: BlurNetwork, plan: Plan) -> ModelProto:
    if isinstance(network.tiles, GatedTiles):
        return gated_model(network, thinned(weights_of(network.tiles), plan.spacing), plan.factors)
    return PublishedGraph(network, [BlockPlan(*each) for each in zip(plan.factors, plan.ranks, strict=True)]).model()


def _rank(block: ResidualBlock) -> int | None:
    """Return the smallest rank with little error in both convolutions of a block, if it takes less time than they do."""
    n = block.radius
    worth = int(_MATRIX_OVER_CONVOLUTION * (2 * n + 1) ** 2 / (2 * (piece_px(n) + 2 * n)))
    both = [kernels_of(each, each.out_channels)[0] for each in (block.first, block.second)]
    for rank in range(1, worth + 1):
        if all(separable_kernels(kernels, rank).relative_error <= SMALL_ERROR for kernels in both):
            return rank
    return None
