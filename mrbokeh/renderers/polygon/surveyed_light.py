"""Surveyed light: a picture and what polygonal differences learn from one look at all its pixels, before they blur it.

What is far out of focus is blurred at half the resolution: its light is smooth, and a quarter of the pixels carries it.
"""

from concurrent.futures import Executor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.system.errors import InputError

NO_HIGHLIGHTS = np.zeros((0, 0), np.float32)
_ROWS_AT_ONCE = 24
_TILES_AT_ONCE = 256


class Tiles(NamedTuple):
    """Tiles that hold light, how many do, the first row of such and the end; the largest diameter; the contrast: the strongest value
    of a channel over the mean of its darkest tile that is not empty, the worst of all channels.
    """

    occupied: Bool[np.ndarray, "rows columns"]
    lit: int
    first: int
    end: int
    largest_px: float
    contrast: float


@dataclass(frozen=True)
class SurveyedLight:
    """Picture after a look at all its pixels: per tile sums and peaks of its channels, the largest diameter, and
    whether all pixels have light.
    """

    values: Float32[np.ndarray, "height width channels"]
    coc_px: Float32[np.ndarray, "height width"]
    sums: Float32[np.ndarray, "rows columns channels"]
    peaks: Float32[np.ndarray, "rows columns channels"]
    largest_of_tile_px: Float32[np.ndarray, "rows columns"]
    least: Float32[np.ndarray, " channels"]
    is_full: Bool[np.ndarray, "rows columns"]

    @classmethod
    def of(
        cls, values: Float32[np.ndarray, "height width channels"], coc_px: Float32[np.ndarray, "height width"], pool: Executor
    ) -> "SurveyedLight":
        from mrbokeh.renderers.polygon._survey_numba import TILE_PX, survey

        values, coc_px = np.ascontiguousarray(values), np.ascontiguousarray(coc_px)
        (height, width, channels) = values.shape
        rows, columns = -(-height // TILE_PX), -(-width // TILE_PX)
        sums, peaks = np.zeros((rows, columns, channels), np.float32), np.zeros((rows, columns, channels), np.float32)
        largest_px, least = np.zeros((rows, columns), np.float32), np.zeros((rows, channels), np.float32)
        is_full = np.zeros((rows, columns), np.bool_)
        each = range(0, rows, _ROWS_AT_ONCE)

        def look(first: int) -> None:
            work, some = np.empty((5, width * channels), np.float32), (first, min(first + _ROWS_AT_ONCE, rows))
            survey(values.reshape(height, -1), coc_px, some, sums, peaks, largest_px, least, is_full, work)

        list(pool.map(look, each))
        return cls(
            values=values, coc_px=coc_px, sums=sums, peaks=peaks, largest_of_tile_px=largest_px, least=least.min(axis=0), is_full=is_full
        )

    @cached_property
    def tiles(self) -> Tiles:
        from mrbokeh.renderers.polygon._survey_numba import look_over

        occupied, work = np.empty(self.largest_of_tile_px.shape, np.bool_), np.empty((2, self.sums.shape[2]), np.float32)
        lit, first, end, largest_px, contrast = look_over(self.sums, self.peaks, self.largest_of_tile_px, occupied, *work)
        if not largest_px < np.inf:
            raise InputError("every visible pixel needs a finite circle of confusion: depth must be positive (or inf), not 0 or NaN")
        return Tiles(occupied=occupied, lit=lit, first=first, end=end, largest_px=largest_px, contrast=contrast)

    @property
    def pixels(self) -> int:
        """Number of pixels in tiles that are not empty."""
        from mrbokeh.renderers.polygon._survey_numba import TILE_PX

        return self.tiles.lit * TILE_PX**2

    def highlights(self, from_px: float, pool: Executor) -> Float32[np.ndarray, "_ _"]:
        """Return how much of each pixel is splatted by its exact kernel; empty if there is no highlight."""
        from mrbokeh.renderers.polygon._survey_numba import find_highlights, find_suspects, integrate

        rows, columns, channels = self.sums.shape
        suspects = np.empty((self.tiles.lit, 2), np.int64)
        count = find_suspects(self.sums, self.peaks, self.largest_of_tile_px, from_px, suspects)
        if count == 0:
            return NO_HIGHLIGHTS
        integral, share = np.empty((rows + 1, columns + 1, channels)), np.zeros(self.coc_px.shape, np.float32)
        integrate(self.sums, integral)
        pieces = [suspects[first : min(first + _TILES_AT_ONCE, count)] for first in range(0, count, _TILES_AT_ONCE)]
        found = pool.map(lambda piece: find_highlights(self.values, self.coc_px, piece, integral, from_px, share), pieces)
        return share if any(list(found)) else NO_HIGHLIGHTS

    def group(self, first: int) -> "SurveyedLight":
        """Return four channels, the last ones filled up with zeros."""
        if self.values.shape[2] == 4:
            return self
        channels = slice(first, first + 4)
        values, sums = (np.zeros((*each.shape[:2], 4), np.float32) for each in (self.values, self.sums))
        least = np.zeros(4, np.float32)
        count = self.values[..., channels].shape[2]
        values[..., :count], sums[..., :count], least[:count] = self.values[..., channels], self.sums[..., channels], self.least[channels]
        return SurveyedLight(
            values=values,
            coc_px=self.coc_px,
            sums=sums,
            peaks=sums,
            largest_of_tile_px=self.largest_of_tile_px,
            least=least,
            is_full=self.is_full,
        )


TOLERANCE = 0.125
"""By how much of the least diameter those around a pixel that is halved may differ."""
FULLY = 1.125
"""At so many times the diameter from which on some of a pixel's light is halved, all of it is."""
LEAST_SHARE = 0.25
"""Of all tiles with light so many must be blurred so far, or halving costs more than it saves."""
_BLOCK_ROWS_AT_ONCE = 32

Blocks = Float32[np.ndarray, "rows columns"]
"""Of every block of 2 x 2 pixels."""
Limits = tuple[float, float, float]
"""from_px, the diameter from which on all light is halved, TOLERANCE."""


@dataclass(frozen=True)
class Halves:
    """Picture in two: `kept` at full resolution, `half` at half of it, None if there is nothing.

    share: of each block of 2 x 2 pixels how much of the light is in `half`; empty if there is nothing.
    """

    kept: SurveyedLight
    half: SurveyedLight | None
    share: Float32[np.ndarray, "rows columns"]


def halves_of(light: SurveyedLight, highlights: Float32[np.ndarray, "_ _"], from_px: float, pool: Executor) -> Halves:
    """Divide a picture in two. light: four channels. highlights: the share of each pixel that is splatted exactly, or empty. from_px:
    see FULLY.
    """
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
    from mrbokeh.renderers.polygon._halves_numba import measure_blocks

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
    from mrbokeh.renderers.polygon._halves_numba import choose_blocks

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
    return [(first, min(first + _BLOCK_ROWS_AT_ONCE, rows)) for first in range(0, rows, _BLOCK_ROWS_AT_ONCE)]
