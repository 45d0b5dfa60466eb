"""Bands: the pieces of work of polygonal differences, the threads that run them, and the working memory of each thread."""

from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import pairwise
from threading import Lock

import numpy as np
from jaxtyping import Bool, Float32, Int64

from mrbokeh.renderers.kernels._vectors_numba import CHUNK_PX
from mrbokeh.renderers.polygon._differences_numba import settle, splat_parts
from mrbokeh.renderers.polygon._ring_numba import ALIASED_ROWS, BLOCK_ROWS, GUARD, Corners, Picture, Ring, Scratch, Target, lay_out
from mrbokeh.renderers.polygon._survey_numba import TILE_PX, find_parts
from mrbokeh.renderers.polygon.surveyed_light import NO_HIGHLIGHTS, SurveyedLight, halves_of
from mrbokeh.renderers.polygon.tables import ApertureTables
from mrbokeh.system.resources import ZeroedMemory


def ring_of(tables: ApertureTables, margin: int, width: int, planes: np.ndarray) -> Ring:
    """Return a ring for parts of a picture of at most this width, in `planes`: at least `ring_elements` zeros."""
    rows, stride = 2 * margin + BLOCK_ROWS, width + 2 * margin
    return Ring(
        planes=planes,
        plane_elements=(rows + 2 * ALIASED_ROWS) * stride * 4,
        light_plane=len(tables.planes),
        rows=rows,
        stride=stride,
        margin=margin,
        left=0,
    )


def ring_elements(tables: ApertureTables, margin: int, width: int) -> int:
    return (len(tables.planes) + 1) * (2 * margin + BLOCK_ROWS + 2 * ALIASED_ROWS) * (width + 2 * margin) * 4


def laid_out(tables: ApertureTables, ring: Ring) -> Corners:
    """Return the corners with steps and places for this ring."""
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


BAND_ROWS = 384
"""Least height of a band; two margins where these are larger. Bands do not depend on the number of threads."""
RING_BYTES = 6 << 20
"""A band is worked through in parts so narrow that the ring fits the cache, but not narrower than four margins."""
SETTLED_ROWS = 128
"""Rows that are completed together when all bands are done."""
FEW_PIXELS = 1 << 18
"""Pictures below this size are one band."""
SPARSE, SPARSE_PART_PX = 0.5, 96
"""Where less than this share of the tiles holds light, parts are narrow, so that they leave out what is dark."""
_LEAST_ROWS = 64


@dataclass(frozen=True)
class Band:
    """Rows top..bottom of a picture, and its parts of equal width that hold light, each first row, end row, left, right."""

    top: int
    bottom: int
    parts: Int64[np.ndarray, "parts 4"]


def bands_of(light: SurveyedLight, margin: int, bytes_per_cell: int) -> list[Band]:
    (height, width), tiles = light.coc_px.shape, light.tiles
    first, end = tiles.first * TILE_PX, min(tiles.end * TILE_PX, height)
    least = _LEAST_ROWS if height * width > FEW_PIXELS else height
    count = max((end - first) // max(BAND_ROWS, 2 * margin), min(2, (end - first) // least), 1)
    cuts = [first + round(k * (end - first) / TILE_PX / count) * TILE_PX for k in range(count)]
    sparse = tiles.lit < SPARSE * tiles.occupied.size
    step = max(SPARSE_PART_PX, 2 * margin) if sparse else _part_width(width, margin, bytes_per_cell)
    return [Band(top, bottom, parts_of(tiles.occupied, top, bottom, width, step, margin)) for top, bottom in pairwise([*cuts, end])]


def _part_width(width: int, margin: int, bytes_per_cell: int) -> int:
    fitting = RING_BYTES // (2 * margin * bytes_per_cell) - 2 * margin
    return -(-width // max(1, round(width / max(fitting, 4 * margin, 256))))


def parts_of(
    occupied: Bool[np.ndarray, "rows columns"], top: int, bottom: int, width: int, step: int, margin: int
) -> Int64[np.ndarray, "parts 4"]:
    """Return parts column by column, `step` px wide; within a column parts are separate if light of one does not reach the other."""
    first, end = top // TILE_PX, -(-bottom // TILE_PX)
    parts = np.empty((-(-width // step) * (end - first), 4), np.int64)
    return parts[: find_parts(occupied, (top, bottom), width, step, margin, parts)]


@dataclass(frozen=True)
class BandRunner:
    """Runner of the bands of all pictures of a call. halve_from_px: see mrbokeh.renderers.polygon.surveyed_light; inf for never."""

    tables: ApertureTables
    dtype: type
    pool: Executor
    threads: int
    memory: ZeroedMemory
    halve_from_px: float

    def sum_resolutions(self, light: SurveyedLight, highlights: Float32[np.ndarray, "_ _"]) -> Float32[np.ndarray, "height width 4"]:
        """Sum the kernels of a picture of four channels, the blurriest parts at half the resolution, and of those the blurriest at
        half of that.
        """
        halves = halves_of(light, highlights, self.halve_from_px, self.pool)
        half = np.zeros((0, 0), np.float32)
        if halves.half is not None:
            half = self.sum_resolutions(halves.half, NO_HIGHLIGHTS)
            half = half.reshape(len(half), -1)
        return self._sum_bands(halves.kept, highlights, halves.share, half)

    def _sum_bands(
        self,
        light: SurveyedLight,
        highlights: Float32[np.ndarray, "_ _"],
        halved: Float32[np.ndarray, "_ _"],
        half: Float32[np.ndarray, "_ _"],
    ) -> Float32[np.ndarray, "height width 4"]:
        """Sum bands one by one, by as many threads as there are; light that leaves its band is added in the order of the bands."""
        out = np.zeros(light.values.shape, np.float32)
        flat, nonnegative = out.reshape(len(out), -1), light.least >= 0.0
        bands, margin = [], 0
        if light.tiles.lit:
            margin = self.tables.margin_px(light.tiles.largest_px)
            bands = bands_of(light, margin, (len(self.tables.planes) + 1) * 4 * np.dtype(self.dtype).itemsize)
        edges = [(band.top, band.bottom) for band in bands] if len(bands) > 1 else [(0, len(out))]
        strays = np.zeros((len(edges), 2, margin if len(bands) > 1 else 0, flat.shape[1]), np.float32)
        targets = [Target(flat, above, below, *rows) for (above, below), rows in zip(strays, edges, strict=True)]
        picture = Picture(
            values=light.values,
            coc_px=light.coc_px,
            share=highlights,
            halved=halved,
            nonnegative=nonnegative,
            largest_px=light.largest_of_tile_px,
        )
        waiting, lock = zip(bands, targets, strict=False), Lock()
        width = max((int((band.parts[:, 3] - band.parts[:, 2]).max()) for band in bands), default=0)
        tables = self.tables

        def work() -> None:
            planes = self.memory.take(ring_elements(tables, margin, width), self.dtype)
            ring = ring_of(tables, margin, width, planes)
            corners, scratch = laid_out(tables, ring), scratch_of(tables, ring)
            while True:
                with lock:
                    piece = next(waiting, None)
                if piece is None:
                    break
                band, target = piece
                splat_parts(picture, corners, tables.sums, tables.exact, ring, scratch, target, band.parts)
            self.memory.give_back(planes)

        list(self.pool.map(lambda _: work(), range(min(self.threads, len(bands)))))
        starts = np.array([[top - margin, bottom] for top, bottom in edges]).reshape(-1)
        pieces = strays.reshape(2 * len(edges), *strays.shape[2:])

        def finish(top: int) -> None:
            target = Target(out=flat, above=strays[0, 0], below=strays[0, 1], top=top, bottom=min(top + SETTLED_ROWS, len(out)))
            settle(target, pieces, starts, half, np.empty(half.shape[1], np.float32), nonnegative)

        list(self.pool.map(finish, range(0, len(out), SETTLED_ROWS)))
        return out
