"""Which circles of confusion each kernel of the gated form serves."""

import math

import torch
from torch import Tensor


def bins_px(blocks: int, per_size: int, signed: bool) -> tuple[list[float], list[int]]:
    """(circles of confusion at which the gates peak, n of each one's kernel), by n, near before far.

    Kernel size 2n+1 serves diameters up to 2n-1: the pixel left on each side is for what the sensor itself blurs (its colour
    filters, the resampling of registration). n = 1 serves 1 px and below (signed: its gate peaks at 0), every other n per_size diameters.
    """
    knots, radii = [0.0 if signed else 1.0], [1]
    for n in range(2, blocks + 1):
        diameters = [2.0 * n - 3.0 + 2.0 * (j + 1) / per_size for j in range(per_size)]
        knots += [-each for each in diameters] + diameters if signed else diameters
        radii += [n] * (len(knots) - len(radii))
    return knots, radii


def blocks_for_gates(largest_coc_px: float) -> int:
    """The smallest N whose largest kernel, 2N+1 px, serves this circle of confusion (diameter)."""
    return max(1, math.ceil((abs(largest_coc_px) + 1.0) / 2.0))


def hat_lines(knots: list[float]) -> Tensor:
    """(4, bins): slope and offset of each hat's rising line, then of its falling line; the outermost hats stay at 1."""
    ascending = sorted(knots)
    lines = []
    for knot in knots:
        i = ascending.index(knot)
        rise = (0.0, 1.0) if i == 0 else _line_to_one(ascending[i - 1], knot)
        fall = (0.0, 1.0) if i == len(knots) - 1 else _line_to_one(ascending[i + 1], knot)
        lines.append((*rise, *fall))
    return torch.tensor(lines).T.contiguous()


def _line_to_one(zero_at: float, one_at: float) -> tuple[float, float]:
    slope = 1.0 / (one_at - zero_at)
    return slope, -zero_at * slope
