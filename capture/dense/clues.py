"""What is known of a viewpoint's depth beside the pictures of its neighbours."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, UInt8

from capture.dense.consistency import ViewDepth
from capture.dense.depth_fusion import FocusVote


@dataclass(frozen=True)
class SparseDepths:
    """Depths known at single places: xy_px (K, 2) in the picture, depth_m (K,) along the axis."""

    xy_px: Float[np.ndarray, "points 2"]
    depth_m: Float[np.ndarray, " points"]

    def dioptre_range(self, margin: float = 0.15) -> tuple[float, float]:
        """(farthest, nearest) of all but the outermost percent, widened by a share of itself on either side."""
        farthest, nearest = np.percentile(1.0 / self.depth_m, [1.0, 99.0])
        spare = margin * (nearest - farthest)
        return max(float(farthest - spare), 0.0), float(nearest + spare)

    def joined(self, other: "SparseDepths") -> "SparseDepths":
        return SparseDepths(np.concatenate([self.xy_px, other.xy_px]), np.concatenate([self.depth_m, other.depth_m]))

    def pixels(self, shape: tuple[int, int], scale: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(row, column, number) of the points inside a picture (height, width) at that scale."""
        column, row = np.floor(self.xy_px * scale).astype(int).T
        chosen = np.flatnonzero((column >= 0) & (column < shape[1]) & (row >= 0) & (row < shape[0]))
        return row[chosen], column[chosen], chosen

    def add_anchors(self, costs: UInt8[np.ndarray, "height width planes"], planes: Float[np.ndarray, " planes"], scale: float) -> None:
        """In place: a known depth rules out, at its pixel, all planes but the few around it. scale: of the costs' picture."""
        row, column, chosen = self.pixels(costs.shape[:2], scale)
        apart = np.abs(planes[None, :] - 1.0 / self.depth_m[chosen, None]) / (planes[1] - planes[0])
        costs[row, column] = np.where(apart > 2.0, 255, costs[row, column] // 2)


@dataclass(frozen=True)
class Clues:
    """What is known beside the pictures: focus, depths at single places, finished depths of neighbours (a second round)."""

    focus: FocusVote | None = None
    sparse: SparseDepths | None = None
    views: Sequence[ViewDepth] = ()
