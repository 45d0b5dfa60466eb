"""Working memory of polygonal differences: a ring of rows of several planes, four channels to a cell, and an aperture's corners in it.

There is one plane of impulses for each pair of directions that meets in a corner, and, last, one plane of light that needs no sums
(in focus, small kernels, highlights).
"""

from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit


@njit(cache=True)
def lay_out(
    steps: np.ndarray,
    places: np.ndarray,
    turned: np.ndarray,
    planes: np.ndarray,
    ring: tuple[int, int],
    laid: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
) -> None:
    """Set step (corners, 2), place (corners, 4), plane and below (corners,) of mrbokeh.renderers.polygon._ring_numba.Corners.

    The first four are those of mrbokeh.renderers.polygon.tables.CrossedCorners. ring: cells to a row, elements to a plane.
    Lines count forwards here; crossing 0 of a corner that is turned lies one line on, one step back.
    """
    (stride, plane_elements), (step, place, plane, below) = ring, laid
    for corner in range(len(planes)):
        plane[corner] = planes[corner] * plane_elements
        for edge in range(2):
            elements = 4 * (steps[corner, edge, 0] + stride * steps[corner, edge, 1])
            step[corner, edge] = -elements if turned[corner, edge] else elements
            plane[corner] -= elements if turned[corner, edge] else 0
        for k in range(4):
            place[corner, k] = 4 * (places[corner, k, 0] + stride * places[corner, k, 1])
        below[corner] = max(max(place[corner, 0], place[corner, 1]), max(place[corner, 2], place[corner, 3])) + 4 * stride


BLOCK_ROWS = 64
"""Rows of which the same columns are splatted before the next columns, so that the cells they share stay in the cache."""
SPARE_PX = 4
"""What corners of edges that lie between lattice lines, and the profiles of edges, may reach beyond the outline."""
GUARD = 16
"""Elements (four cells) before the first of a row of sums, which a step to the side may reach."""
ALIASED_ROWS = 4
"""Rows before and after the ring proper that stand for its last and first ones: a corner reaches a few rows beyond its own."""
APART_PX = 8
"""Pixels that follow one another when they are splatted are so far apart: neighbours add to overlapping pairs of cells, and
the second would wait for the first."""

compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"}, _nrt=False)
"""Without counting references, which would be atomic and cost as much as the work: nothing here allocates."""


class Corners(NamedTuple):
    """PolygonCorners (mrbokeh.renderers.polygon.directional_differences) laid out for one ring: steps and places count array elements.

    Crossings of a corner that are neighbours in a row are added to together, so corners come in three kinds: up to `level`
    crossings 0 and 1 are neighbours and so are 2 and 3, up to `steep` 1 and 2 are, and of the rest none. place (corners, 4):
    where they are from crossing 0 on, in pairs as mrbokeh.renderers.kernels._vectors_numba stores their weights. step, turned
    (corners, 2): of the edge before and the one after, what one line on moves the crossing, and 1 where their two lines count
    backwards, 0 elsewhere. below: the row under the lowest crossing. extent: farthest reach of an outline at radius 1.
    """

    slope: np.ndarray
    shift: np.ndarray
    origin: np.ndarray
    curvature: np.ndarray
    before: np.ndarray
    after: np.ndarray
    step: np.ndarray
    turned: np.ndarray
    plane: np.ndarray
    place: np.ndarray
    below: np.ndarray
    weight: np.ndarray
    level: int
    steep: int
    area: float
    area_offset: float
    growth: float
    extent: float


class Sums(NamedTuple):
    """Planes that feed each direction, and the profile by which each sum goes to the picture; index arrays end with the total."""

    step_x: np.ndarray
    step_y: np.ndarray
    shift: np.ndarray
    input_start: np.ndarray
    input_plane: np.ndarray
    input_weight: np.ndarray
    profile_start: np.ndarray
    profile_x: np.ndarray
    profile_y: np.ndarray
    profile_weight: np.ndarray
    row_start: np.ndarray


class Exact(NamedTuple):
    """Kernels that are splatted whole.

    lower, rise: taps of kernels of small diameters, in groups of neighbours, and what to add to them to reach those of the next
    level; `per_px` levels to a pixel, from 1 px on, `levels` behind the focus and then as many in front. row, column
    (groups,): counted from -radius on, and 4 times counted from the pixel. start: with which group each level begins, and the end.
    from_px, to_px: between these diameters the sums take over. vertices, starts, weights, unit_radius: the aperture itself.
    """

    lower: np.ndarray
    rise: np.ndarray
    row: np.ndarray
    column: np.ndarray
    start: np.ndarray
    levels: int
    radius: int
    per_px: float
    from_px: float
    to_px: float
    vertices: np.ndarray
    starts: np.ndarray
    weights: np.ndarray
    unit_radius: float


class Ring(NamedTuple):
    """Ring of rows. planes: flat, light plane last. Row r of the ring proper starts at (ALIASED_ROWS + r) * stride cells.

    Column x of the picture is cell x - left + margin of a row.
    """

    planes: np.ndarray
    plane_elements: int
    light_plane: int
    rows: int
    stride: int
    margin: int
    left: int


class Scratch(NamedTuple):
    """Work space of one thread.

    sums: (rows of all directions, 4 stride + 2 GUARD). total: (4 stride). small, small_share: the pixels of a chunk with small
    kernels, and how much of their light these spread. rows: where column 0 of the picture is in the rows
    that small kernels reach. taps: for a row of a kernel. kernel: 2 times the largest kernel.
    """

    element: np.ndarray
    radius: np.ndarray
    gain: np.ndarray
    line: np.ndarray
    share: np.ndarray
    target: np.ndarray
    weight: np.ndarray
    sums: np.ndarray
    total: np.ndarray
    carry: np.ndarray
    small: np.ndarray
    small_share: np.ndarray
    rows: np.ndarray
    taps: np.ndarray
    kernel: np.ndarray


class Picture(NamedTuple):
    """Picture of four channels: values (H, W, 4) and coc_px (H, W) float32; share (H, W) of highlights, halved (blocks of 2 x 2) that
    is blurred at half the resolution, each empty if there is none; nonnegative: channels without values below 0; largest_px: of
    pixels with light, of each tile.
    """

    values: np.ndarray
    coc_px: np.ndarray
    share: np.ndarray
    halved: np.ndarray
    nonnegative: np.ndarray
    largest_px: np.ndarray


class Target(NamedTuple):
    """Target of the light of a band of rows top..bottom: out (H, 4 W); above and below (rows, 4 W) take the light that leaves the band."""

    out: np.ndarray
    above: np.ndarray
    below: np.ndarray
    top: int
    bottom: int
