"""The pieces of work of polygon_differences, and the threads that work through them."""

from collections.abc import Iterator
from concurrent.futures import Executor
from dataclasses import dataclass
from itertools import pairwise
from threading import Lock

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.renderers._polygon_differences_numba import settle, spread_part
from mrbokeh.renderers._polygon_light import SurveyedLight
from mrbokeh.renderers._polygon_memory import ZeroedMemory
from mrbokeh.renderers._polygon_ring_numba import Picture, Target
from mrbokeh.renderers._polygon_survey_numba import TILE_PX
from mrbokeh.renderers._polygon_tables import ApertureTables, laid_out, ring_elements, ring_of, scratch_of

BAND_ROWS = 384
"""Least height of a band; two margins where these are larger. Bands do not depend on the number of threads."""
RING_BYTES = 6 << 20
"""A band is worked through in parts so narrow that the ring fits the cache, but not narrower than four margins."""
FEW_PIXELS = 1 << 15
"""Pictures below this size are one band."""
_LEAST_ROWS = 64


@dataclass(frozen=True)
class Band:
    """Rows top..bottom of a picture: parts of equal width of it that hold light, as (first row, end row, left, right)."""

    top: int
    bottom: int
    parts: tuple[tuple[int, int, int, int], ...]


def bands_of(light: SurveyedLight, margin: int, bytes_per_cell: int) -> list[Band]:
    height, width = light.coc_px.shape
    occupied = np.any(light.sums > 0, axis=2)
    rows = np.flatnonzero(occupied.any(axis=1)) * TILE_PX
    first, end = int(rows[0]), min(int(rows[-1]) + TILE_PX, height)
    least = _LEAST_ROWS if height * width > FEW_PIXELS else height
    count = max((end - first) // max(BAND_ROWS, 2 * margin), min(2, (end - first) // least), 1)
    cuts = first + np.rint(np.linspace(0, (end - first) / TILE_PX, count + 1)).astype(int) * TILE_PX
    cuts[-1] = end
    step = _part_width(width, margin, bytes_per_cell)
    return [Band(int(top), int(bottom), tuple(_parts(occupied, int(top), int(bottom), width, step))) for top, bottom in pairwise(cuts)]


def _part_width(width: int, margin: int, bytes_per_cell: int) -> int:
    fitting = RING_BYTES // (2 * margin * bytes_per_cell) - 2 * margin
    return -(-width // max(1, round(width / max(fitting, 4 * margin, 256))))


def _parts(occupied: Bool[np.ndarray, "rows columns"], top: int, bottom: int, width: int, step: int) -> Iterator[tuple[int, int, int, int]]:
    for start in range(0, width, step):
        end = min(start + step, width)
        tiles = occupied[top // TILE_PX : -(-bottom // TILE_PX), start // TILE_PX : -(-end // TILE_PX)]
        rows, columns = np.flatnonzero(tiles.any(axis=1)), np.flatnonzero(tiles.any(axis=0))
        if rows.size:
            left, right = (start // TILE_PX + int(columns[0])) * TILE_PX, (start // TILE_PX + int(columns[-1]) + 1) * TILE_PX
            yield top + int(rows[0]) * TILE_PX, min(top + (int(rows[-1]) + 1) * TILE_PX, bottom), max(left, start), min(right, end)


def spread_four(
    light: SurveyedLight,
    share: Float32[np.ndarray, "_ _"],
    tables: ApertureTables,
    dtype: type,
    pool: Executor,
    workers: int,
    memory: ZeroedMemory,
) -> Float32[np.ndarray, "height width 4"]:
    """Bands one by one, by as many threads as there are; what light leaves its band is added in the order of the bands."""
    out = np.zeros_like(light.values)
    if not light.sums.any():
        return out
    margin = tables.margin_px(light.largest_px)
    bands = bands_of(light, margin, (len(tables.planes) + 1) * 4 * np.dtype(dtype).itemsize)
    width = max(right - left for band in bands for _, _, left, right in band.parts)
    picture = Picture(light.values, light.coc_px, share, light.least >= 0.0)
    flat = out.reshape(len(out), -1)
    edges = [(band.top, band.bottom) for band in bands] if len(bands) > 1 else [(0, len(out))]
    strays = np.zeros((len(bands), 2, margin if len(bands) > 1 else 0, flat.shape[1]), np.float32)
    targets = [Target(flat, above, below, *rows) for (above, below), rows in zip(strays, edges, strict=True)]
    waiting, lock = iter(zip(bands, targets, strict=True)), Lock()

    def work() -> None:
        planes = memory.take(ring_elements(tables, margin, width), dtype)
        ring = ring_of(tables, margin, width, planes)
        corners, scratch = laid_out(tables, ring), scratch_of(tables, ring)
        while True:
            with lock:
                piece = next(waiting, None)
            if piece is None:
                break
            band, target = piece
            for first, end, left, right in band.parts:
                spread_part(picture, corners, tables.sums, tables.exact, ring._replace(left=left), scratch, target, first, end, right)
        memory.give_back(planes)

    list(pool.map(lambda _: work(), range(min(workers, len(bands)))))
    starts = np.array([[top - margin, bottom] for top, bottom in edges]).reshape(-1)
    pieces, cuts = strays.reshape(2 * len(bands), *strays.shape[2:]), np.linspace(0, len(out), 2 * len(bands) + 1).astype(int)
    settled = [Target(flat, strays[0, 0], strays[0, 1], int(top), int(bottom)) for top, bottom in pairwise(cuts)]
    list(pool.map(lambda target: settle(target, pieces, starts, picture.nonnegative), settled))
    return out
