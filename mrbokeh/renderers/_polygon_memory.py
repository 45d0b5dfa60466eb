"""The working memory of polygon_differences, and the corners of an aperture as places in it."""

import numpy as np

from mrbokeh.renderers._polygon_aim_numba import CHUNK_PX
from mrbokeh.renderers._polygon_ring_numba import ALIASED_ROWS, BLOCK_ROWS, GUARD, Corners, Ring, Scratch
from mrbokeh.renderers._polygon_tables import ApertureTables


def ring_of(tables: ApertureTables, margin: int, width: int, planes: np.ndarray) -> Ring:
    """A ring for parts of a picture of at most this width, in `planes`: at least `ring_elements` zeros."""
    rows, stride = 2 * margin + BLOCK_ROWS, width + 2 * margin
    return Ring(planes, (rows + 2 * ALIASED_ROWS) * stride * 4, len(tables.planes), rows, stride, margin, 0)


def ring_elements(tables: ApertureTables, margin: int, width: int) -> int:
    return (len(tables.planes) + 1) * (2 * margin + BLOCK_ROWS + 2 * ALIASED_ROWS) * (width + 2 * margin) * 4


def laid_out(tables: ApertureTables, ring: Ring) -> Corners:
    """Lines count forwards here; crossing 0 of a corner that is turned lies one line on, one step back."""
    corners, crossed = tables.corners, tables.crossed
    column_and_row = 4 * np.array([1, ring.stride])
    steps, places = crossed.steps @ column_and_row, crossed.places @ column_and_row
    return Corners(
        slope=corners.slope.astype(ring.planes.dtype),
        shift=corners.shift.astype(ring.planes.dtype),
        origin=corners.origin.astype(ring.planes.dtype),
        curvature=corners.curvature.astype(ring.planes.dtype),
        before=crossed.before,
        after=crossed.after,
        step=np.where(crossed.turned, -steps, steps),
        turned=crossed.turned.astype(np.float64),
        plane=crossed.plane * ring.plane_elements - (crossed.turned * steps).sum(axis=1),
        place=places,
        below=places.max(axis=1) + 4 * ring.stride,
        weight=crossed.weight,
        level=crossed.level,
        steep=crossed.steep,
        area=corners.area[0],
        area_offset=corners.area[1],
        growth=corners.growth,
        extent=tables.extent,
    )


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
