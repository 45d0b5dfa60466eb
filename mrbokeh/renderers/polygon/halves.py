"""What is far out of focus is spread at half the resolution: its light is smooth, and a quarter of the pixels carries it."""

from concurrent.futures import Executor
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.renderers.polygon.light import SurveyedLight

TOLERANCE = 0.125
"""By how much of the least diameter those around a pixel that is halved may differ."""
FULLY = 1.125
"""At so many times the diameter from which on some of a pixel's light is halved, all of it is."""
LEAST_SHARE = 0.25
"""Of all tiles with light so many must be blurred so far, or halving costs more than it saves."""
_ROWS_AT_ONCE = 32

Blocks = Float32[np.ndarray, "rows columns"]
"""Of every block of 2 x 2 pixels."""
Limits = tuple[float, float, float]
"""from_px, the diameter from which on all light is halved, TOLERANCE."""


@dataclass(frozen=True)
class Halves:
    """A picture in two: `kept` at full resolution, `half` at half of it, None if there is nothing.

    share: of each block of 2 x 2 pixels how much of the light is in `half`; empty if there is nothing.
    """

    kept: SurveyedLight
    half: SurveyedLight | None
    share: Float32[np.ndarray, "rows columns"]


def halves_of(light: SurveyedLight, highlights: Float32[np.ndarray, "_ _"], from_px: float, pool: Executor) -> Halves:
    """light: four channels. highlights: the share of each pixel that is spread exactly, or empty. from_px: see FULLY."""
    nothing = Halves(light, None, np.zeros((0, 0), np.float32))
    far = light.largest_of_tile_px > FULLY * from_px
    if not far.any() or far.sum() < LEAST_SHARE * light.sums.any(axis=2).sum():
        return nothing
    limits = (from_px, FULLY * from_px, TOLERANCE)
    lowest, highest = _diameters_of_blocks(light, limits, pool)
    share, weighted_px, largest_px, kept = _chosen(lowest, highest, light.largest_of_tile_px, limits, pool)
    if not share.any():
        return nothing
    if highlights.size:
        lamps = _tiles_with(highlights, kept.shape)
        largest_px, kept = np.where(lamps, light.largest_of_tile_px, largest_px), kept | lamps
    left = replace(light, largest_of_tile_px=largest_px, sums=light.sums * kept[..., None])
    return Halves(left, SurveyedLight.of(*_halved(light.values, highlights, share, weighted_px, pool), pool), share)


def _tiles_with(highlights: Float32[np.ndarray, "height width"], tiles: tuple[int, ...]) -> Bool[np.ndarray, "rows columns"]:
    from mrbokeh.renderers.polygon._survey_numba import TILE_PX

    found = np.zeros(tiles, np.bool_)
    y, x = np.nonzero(highlights)
    found[y // TILE_PX, x // TILE_PX] = True
    return found


def _diameters_of_blocks(light: SurveyedLight, limits: Limits, pool: Executor) -> tuple[Blocks, Blocks]:
    from mrbokeh.renderers.polygon._blocks_numba import measure_blocks

    height, width = light.coc_px.shape
    lowest, highest = (np.empty((-(-height // 2), -(-width // 2)), np.float32) for _ in range(2))
    of_tiles = np.where(light.sums.any(axis=2), light.largest_of_tile_px, np.inf).astype(np.float32)

    def measure(tile_rows: tuple[int, int]) -> None:
        measure_blocks(light.values, light.coc_px, of_tiles, light.is_full, tile_rows, limits, lowest, highest)

    list(pool.map(measure, _pieces(len(of_tiles))))
    return lowest, highest


def _chosen(
    lowest: Blocks, highest: Blocks, of_tiles: Float32[np.ndarray, "_ _"], limits: Limits, pool: Executor
) -> tuple[Blocks, Blocks, Float32[np.ndarray, "_ _"], Bool[np.ndarray, "_ _"]]:
    from mrbokeh.renderers.polygon._blocks_numba import choose_blocks

    share, weighted_px = np.empty_like(lowest), np.empty_like(lowest)
    largest_px, kept = of_tiles.copy(), np.empty(of_tiles.shape, np.bool_)

    def choose(tile_rows: tuple[int, int]) -> None:
        work = np.empty((2, lowest.shape[1] + 2), np.float32)
        choose_blocks(lowest, highest, tile_rows, limits, share, weighted_px, largest_px, kept, work)

    list(pool.map(choose, _pieces(len(kept))))
    return share, weighted_px, largest_px, kept


def _halved(
    values: Float32[np.ndarray, "height width 4"],
    highlights: Float32[np.ndarray, "_ _"],
    share: Blocks,
    weighted_px: Blocks,
    pool: Executor,
) -> tuple[Float32[np.ndarray, "cell_rows cell_columns 4"], Float32[np.ndarray, "cell_rows cell_columns"]]:
    from mrbokeh.renderers.polygon._halves_numba import halve_diameters, halve_rows

    (rows, columns), flat = share.shape, values.reshape(len(values), -1)
    half, half_coc_px = np.empty((rows + 2, columns + 2, 4), np.float32), np.empty((rows + 2, columns + 2), np.float32)

    def halve(cell_rows: tuple[int, int]) -> None:
        line, work = np.empty(8 * columns + 24, np.float32), np.empty((2, columns + 4), np.float32)
        halve_rows(flat, highlights, share, cell_rows, line, half.reshape(len(half), -1))
        halve_diameters(share, weighted_px, cell_rows, work, half_coc_px)

    list(pool.map(halve, _pieces(rows + 2)))
    return half, half_coc_px


def _pieces(rows: int) -> list[tuple[int, int]]:
    return [(first, min(first + _ROWS_AT_ONCE, rows)) for first in range(0, rows, _ROWS_AT_ONCE)]
