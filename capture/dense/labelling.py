"""From costs of planes to one plane per pixel: semi-global labelling (Hirschmueller 2008) that lets depth jump where the picture does."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, UInt8, UInt16

Plane = Float32[np.ndarray, "height width"]
Costs = UInt8[np.ndarray, "height width planes"]

DIRECTIONS = ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1))
_RIVAL_APART = 2


@dataclass(frozen=True)
class Penalties:
    """small: for a step to the next plane, large: for any farther one (both in units of cost, 255 is no agreement at all).

    contrast: where the guide changes by this much between two pixels, a jump of depth costs half.
    """

    small: float = 30.0
    large: float = 500.0
    contrast: float = 0.02


@dataclass(frozen=True)
class Labels:
    """index (H, W): fractional index of the plane; margin: how much dearer the best other plane is, per path, in units of cost."""

    index: Plane
    margin: Plane


def label_planes(costs: Costs, guide: Plane, penalties: Penalties | None = None) -> Labels:
    """The labelling of all pixels together. Memory: 2 bytes per cell beside the costs."""
    from capture.dense._labelling_numba import aggregate, winners

    rules = penalties or Penalties()
    total = aggregate(costs, guide, rules.small, rules.large, rules.contrast)
    index, margin = (np.empty(guide.shape, np.float32) for _ in range(2))
    winners(total, _RIVAL_APART, index, margin)
    return Labels(index, margin / np.float32(len(DIRECTIONS)))


def aggregate_plainly(costs: Costs, guide: Plane, penalties: Penalties) -> UInt16[np.ndarray, "height width planes"]:
    """Sums of path costs over eight directions, pixel by pixel: the plain twin of `_dense_labelling_numba.aggregate`."""
    height, width, planes = costs.shape
    total = np.zeros(costs.shape, np.uint16)
    jumps = np.abs(np.arange(planes)[:, None] - np.arange(planes)[None, :])
    for dx, dy in DIRECTIONS:
        path = np.zeros(costs.shape)
        for y in range(height)[:: dy or 1]:
            for x in range(width)[:: dx or 1]:
                path[y, x] = costs[y, x]
                if 0 <= x - dx < width and 0 <= y - dy < height:
                    before = path[y - dy, x - dx]
                    edge = abs(float(guide[y, x]) - float(guide[y - dy, x - dx]))
                    large = max(penalties.large / (1.0 + edge / penalties.contrast), penalties.small)
                    path[y, x] += _cheapest_step(before, jumps, penalties.small, large)
        total += path.astype(np.uint16)
    return total


def _cheapest_step(before: Float[np.ndarray, " planes"], jumps: np.ndarray, small: float, large: float) -> Float[np.ndarray, " planes"]:
    """Hirschmueller's Eq. 13: the least of all ways to each label, less the cheapest of the pixel before."""
    penalty = np.where(jumps == 0, 0.0, np.where(jumps == 1, small, large))
    return (before[None, :] + penalty).min(axis=1) - before.min()
