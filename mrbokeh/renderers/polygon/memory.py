"""The working memory of polygon_differences, and the corners of an aperture as places in it."""

import numpy as np

from mrbokeh.renderers.polygon._aim_numba import CHUNK_PX
from mrbokeh.renderers.polygon._places_numba import lay_out
from mrbokeh.renderers.polygon._ring_numba import ALIASED_ROWS, BLOCK_ROWS, GUARD, Corners, Ring, Scratch
from mrbokeh.renderers.polygon.tables import ApertureTables


def ring_of(tables: ApertureTables, margin: int, width: int, planes: np.ndarray) -> Ring:
    """A ring for parts of a picture of at most this width, in `planes`: at least `ring_elements` zeros."""
    rows, stride = 2 * margin + BLOCK_ROWS, width + 2 * margin
    return Ring(planes, (rows + 2 * ALIASED_ROWS) * stride * 4, len(tables.planes), rows, stride, margin, 0)


def ring_elements(tables: ApertureTables, margin: int, width: int) -> int:
    return (len(tables.planes) + 1) * (2 * margin + BLOCK_ROWS + 2 * ALIASED_ROWS) * (width + 2 * margin) * 4


def laid_out(tables: ApertureTables, ring: Ring) -> Corners:
    """The corners with steps and places for this ring."""
    crossed, count = tables.crossed, len(tables.crossed.plane)
    step, place, plane, below = (np.empty(shape, np.int64) for shape in ((count, 2), (count, 4), count, count))
    lay_out(crossed.steps, crossed.places, crossed.turned, crossed.plane, (ring.stride, ring.plane_elements), (step, place, plane, below))
    return tables.corners_in(ring.planes.dtype)._replace(step=step, place=place, plane=plane, below=below)


def scratch_of(tables: ApertureTables, ring: Ring) -> Scratch:
    edges, corners = len(tables.corners.slope), len(tables.corners.weight)
    dtype = ring.planes.dtype
    return Scratch(
        element=np.zeros(CHUNK_PX, np.int32),
        radius=np.zeros(CHUNK_PX, dtype),
        gain=np.zeros(2 * CHUNK_PX, dtype),
        line=np.zeros(edges * CHUNK_PX, np.int32),
        share=np.zeros(edges * CHUNK_PX, dtype),
        target=np.zeros((corners + 1) * CHUNK_PX, np.int32),
        weight=np.zeros(4 * corners * CHUNK_PX, dtype),
        sums=np.zeros((int(tables.sums.row_start[-1]), 4 * ring.stride + 2 * GUARD)),
        total=np.zeros(4 * ring.stride),
        carry=np.zeros(4),
        small=np.zeros(CHUNK_PX, np.int32),
        small_share=np.zeros(CHUNK_PX, np.float32),
        rows=np.zeros(2 * tables.exact.radius + 1, np.int64),
        taps=np.zeros(2 * ring.margin + 1, dtype),
        kernel=np.zeros((2, (2 * ring.margin + 1) ** 2)),
    )
