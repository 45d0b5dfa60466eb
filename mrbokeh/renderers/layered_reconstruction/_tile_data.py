"""What the kernels share: samples sorted by tile, and how they are to be filtered."""

from typing import NamedTuple

import numpy as np

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
    """Numbers of Settings. every: one sample of so many makes the statistics. kind: of the screen filter. alpha: of Eq. 3.

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
    """A sample is reprojected to x' = x - a (u, v) - (b_x, b_y) (t - 1/2)."""

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
    """Of one tile, front to back: sums (P, SUMS), first depth bucket (P,), and the place of every bucket among them.

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
