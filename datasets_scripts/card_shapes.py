"""Outlines of flat cards as distance fields: positive inside, in pixels, on a grid finer than the pixels.

The grid covers the frame and a margin round it; between its points it is read bilinearly, and that is the exact shape.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from jaxtyping import Float

Distances = Float[np.ndarray, "rows columns"]


@dataclass(frozen=True)
class TexelGrid:
    """Where the texels of a card lie: `density` per pixel over a frame with `margin_px` more on every side."""

    height_px: int
    width_px: int
    margin_px: int
    density: int = 2

    @property
    def shape(self) -> tuple[int, int]:
        return (self.height_px + 2 * self.margin_px) * self.density, (self.width_px + 2 * self.margin_px) * self.density

    def positions_px(self) -> tuple[Distances, Distances]:
        """x and y of every texel centre in pixels of the frame."""
        rows, columns = self.shape
        x = (np.arange(columns) + 0.5) / self.density - self.margin_px
        y = (np.arange(rows) + 0.5) / self.density - self.margin_px
        return np.broadcast_to(x, self.shape), np.broadcast_to(y[:, None], self.shape)


def mirrored_beyond(grid: TexelGrid, texels: Float[np.ndarray, "rows columns *channels"]) -> Float[np.ndarray, "rows columns *channels"]:
    """The same within the frame; beyond it, its mirror image."""
    margin = grid.margin_px * grid.density
    frame = texels[margin:-margin, margin:-margin]
    return np.pad(frame, ((margin, margin), (margin, margin)) + ((0, 0),) * (texels.ndim - 2), mode="symmetric")


def everywhere(grid: TexelGrid) -> Distances:
    return np.full(grid.shape, 1e3)


def nowhere(grid: TexelGrid) -> Distances:
    return np.full(grid.shape, -1e3)


def rectangle(grid: TexelGrid, left: float, top: float, right: float, bottom: float, turn_rad: float = 0.0) -> Distances:
    """A rectangle turned about its centre."""
    x, y = grid.positions_px()
    dx, dy = x - 0.5 * (left + right), y - 0.5 * (top + bottom)
    along, across = np.cos(turn_rad) * dx + np.sin(turn_rad) * dy, np.cos(turn_rad) * dy - np.sin(turn_rad) * dx
    return np.minimum(0.5 * (right - left) - abs(along), 0.5 * (bottom - top) - abs(across))


def disc(grid: TexelGrid, x_px: float, y_px: float, radius_px: float) -> Distances:
    x, y = grid.positions_px()
    return radius_px - np.hypot(x - x_px, y - y_px)


def leaf(grid: TexelGrid, x_px: float, y_px: float, length_px: float, turn_rad: float, slender: float = 0.42) -> Distances:
    """A pointed leaf: the overlap of two discs; `slender` is its width over its length."""
    half, sag = 0.5 * length_px, 0.5 * length_px * slender
    radius = (half**2 + sag**2) / (2.0 * sag)
    away, nx, ny = radius - sag, -np.sin(turn_rad), np.cos(turn_rad)
    return np.minimum(disc(grid, x_px + nx * away, y_px + ny * away, radius), disc(grid, x_px - nx * away, y_px - ny * away, radius))


def wire(grid: TexelGrid, points_px: Sequence[tuple[float, float]], width_px: float) -> Distances:
    """A chain of straight pieces of one width with round ends."""
    x, y = grid.positions_px()
    distance = np.full(grid.shape, np.inf)
    for (x0, y0), (x1, y1) in pairwise(points_px):
        dx, dy = x1 - x0, y1 - y0
        t = np.clip(((x - x0) * dx + (y - y0) * dy) / (dx * dx + dy * dy), 0.0, 1.0)
        distance = np.minimum(distance, np.hypot(x - x0 - t * dx, y - y0 - t * dy))
    return 0.5 * width_px - distance


def union(*shapes: Distances) -> Distances:
    return np.maximum.reduce(shapes)


def without(shape: Distances, hole: Distances) -> Distances:
    return np.minimum(shape, -hole)
