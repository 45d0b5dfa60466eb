"""Data that the compiled loops share: samples sorted by tile, how they are filtered, and the opening of the lens as strips along u.

The window filter sums over the strips, and rays are sent through them.
"""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float64, Int64

from mrbokeh.optics.aperture import Aperture

STRIPS = (8, 16, 32, 64)
"""How many strips a diameter has in the coarse to fine drawings of a pupil."""

_LEAST_WIDTH = 1e-9
_LEAST_SHARE = 1e-4


def pupil_spans(aperture: Aperture, strips: int) -> Float64[np.ndarray, "spans 5"]:
    """Return all stretches that let light pass on `strips` lines across a plain aperture: v, from u, to u, weight, height in v.

    The weights sum to 1.
    """
    corners = np.concatenate(aperture.outlines)
    low, high = float(corners[:, 1].min()), float(corners[:, 1].max())
    lines = low + (np.arange(strips) + 0.5) * (high - low) / strips
    table = np.array([(v, *stretch, (high - low) / strips) for v in lines.tolist() for stretch in _open_stretches(aperture, v)])
    table[:, 3] /= table[:, 3].sum()
    return table


def packed_pupil(
    aperture: Aperture, across: int = 1
) -> tuple[Float64[np.ndarray, "spans 5"], Int64[np.ndarray, " starts"], Float64[np.ndarray, " cells"]]:
    """Return all drawings of what is seen in front of the focus, then of what is seen behind it, each in its cells; where each begins; the
    share of the light that comes through each cell.

    across: cells along either side of the box around the opening; those that nothing comes through are left out. Weights of a
    cell sum to 1.
    """
    corners = np.concatenate(aperture.outlines)
    low, high = corners.min(axis=0), corners.max(axis=0)
    drawings = [_in_cells(pupil_spans(aperture.seen(side), strips), low, high, across) for side in (-1, 1) for strips in STRIPS]
    light = np.array([[cell[:, 3].sum() for cell in drawing] for drawing in drawings])
    is_open = np.all(light > _LEAST_SHARE, axis=0)
    tables = [cell * (1, 1, 1, 1 / share, 1) for drawing, row in zip(drawings, light, strict=True)
              for cell, share, kept in zip(drawing, row, is_open, strict=True) if kept]  # fmt: skip
    shares = light[:, is_open][[len(STRIPS) - 1, -1]].mean(axis=0)
    return np.concatenate(tables), np.cumsum([0, *(len(table) for table in tables)]), shares / shares.sum()


def _in_cells(
    spans: Float64[np.ndarray, "spans 5"], low: Float64[np.ndarray, "2"], high: Float64[np.ndarray, "2"], across: int
) -> list[Float64[np.ndarray, "_ 5"]]:
    """Cut the strips by across x across cells of the box from low to high, u first; weights by area."""
    u, v = (np.linspace(low[axis], high[axis], across + 1) for axis in (0, 1))
    middle, from_u, to_u, weight, height = spans.T
    cells = []
    for j, i in np.ndindex(across, across):
        left, right = np.maximum(from_u, u[i]), np.minimum(to_u, u[i + 1])
        top, bottom = np.maximum(middle - height / 2, v[j]), np.minimum(middle + height / 2, v[j + 1])
        area = (right - left) / (to_u - from_u) * (bottom - top) / height
        inside = (right - left > _LEAST_WIDTH) & (bottom - top > _LEAST_WIDTH)
        cells.append(np.column_stack([(top + bottom) / 2, left, right, weight * area, bottom - top])[inside])
    return cells


def _open_stretches(aperture: Aperture, v: float) -> list[tuple[float, float, float]]:
    """Return (from u, to u, length times weight) along one line, where the weights of all outlines together are above 0."""
    steps = []
    for outline, weight in zip(aperture.outlines, aperture.weights, strict=True):
        steps += [(u, weight if k % 2 == 0 else -weight) for k, u in enumerate(_crossings(outline, v))]
    steps.sort()
    stretches, open_share = [], 0.0
    for (u, step), (following, _) in pairwise(steps):
        open_share += step
        if open_share > _LEAST_WIDTH and following - u > _LEAST_WIDTH:
            stretches.append((u, following, open_share * (following - u)))
    return stretches


def _crossings(outline: Float64[np.ndarray, "points 2"], v: float) -> list[float]:
    """Return where a closed outline crosses the line of this v, from left to right."""
    closed = np.concatenate([outline, outline[:1]])
    below = closed[:, 1] <= v
    at = np.flatnonzero(below[1:] != below[:-1])
    a, b = closed[at], closed[at + 1]
    return sorted((a[:, 0] + (v - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])).tolist())


BLOCKS_ACROSS = 4
BLOCKS = BLOCKS_ACROSS**2
"""Squares that a tile is divided into, 4 x 4 in Morton order."""


class Light(NamedTuple):
    """Samples in tiles, within a tile in Morton order of their pixels.

    geometry: (N, 5) x, y, u, v, t - 1/2. slopes: (N, 3) half the signed circle of confusion, motion x and y. values: (N, C).
    bucket: (N,) depth bucket times `cells` plus cell of motion. starts: of each sixteenth of a tile, and the end.
    columns: of tiles. tile_px: side of a tile. cells_x: of motion, along x; cells: of both axes together.
    window: second moments uu, uv, vv of the pupil and tt of the shutter, as the samples fill them. per_pixel: samples.
    """

    geometry: np.ndarray
    slopes: np.ndarray
    values: np.ndarray
    bucket: np.ndarray
    starts: np.ndarray
    columns: int
    tile_px: int
    cells_x: int
    cells: int
    depths: int
    window: np.ndarray
    pupil_radius: float
    per_pixel: float


class Choice(NamedTuple):
    """Settings as numbers. every: one sample of so many makes the statistics. kind: of the screen filter. alpha: of Eq. 3.

    times: stretches of the shutter that are composited on their own. part_tolerance: 0 where parts are never merged.
    """

    every: int
    seed: int
    merge: bool
    tolerance: float
    sigma_x_px: float
    bandwidth: float
    kind: int
    support: float
    passes: int
    alpha: float
    tap_distance: float
    enough: float
    shared_out: bool
    times: int
    part_tolerance: float
    faint: float


class Slope(NamedTuple):
    """Slopes by which a sample is reprojected to x' = x - a (u, v) - (b_x, b_y) (t - 1/2)."""

    a: float
    b_x: float
    b_y: float


class Pupil(NamedTuple):
    """Drawings of the opening, coarse to fine, first as seen in front of the focus, each in its cells; see `packed_pupil`.

    shares: (cells,) of the light.
    """

    spans: np.ndarray
    starts: np.ndarray
    shares: np.ndarray


class Partitions(NamedTuple):
    """Partitions of one tile, front to back: sums (P, SUMS), first depth bucket (P,), and the place of every bucket among them.

    place: (B,) 2 j for buckets of the partition j; -1 for those that no partition knows, which lie where `gaps` (depths,) says:
    2 j - 1 in front of the partition j.
    """

    sums: np.ndarray
    first: np.ndarray
    place: np.ndarray
    gaps: np.ndarray


class WindowLayer(NamedTuple):
    """A partition around a tile, reprojected and not yet filtered: planes (h + 2 guard_y + 2 guard, w + 2 guard_x + 2 guard, C + 2) of
    colour, opacity and weight.

    scale: radius in px of the pupil's picture, negative in front of the focus. length_x, length_y: the segment of the shutter in px.
    guard_x, guard_y: bands around the tile that the segment needs. guard: beyond them, that of the pupil.
    """

    planes: np.ndarray
    scale: float
    length_x: float
    length_y: float
    guard_x: int
    guard_y: int
    guard: int
