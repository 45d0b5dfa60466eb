"""What polygon_differences learns from one look at all pixels, before it spreads them."""

from concurrent.futures import Executor
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.system.errors import InputError

NO_HIGHLIGHTS = np.zeros((0, 0), np.float32)
_ROWS_AT_ONCE = 24
_TILES_AT_ONCE = 256


class Tiles(NamedTuple):
    """Which tiles hold light and how many do, the first row of such and the end; the largest diameter; the strongest value of a
    channel over the mean of its darkest tile that is not empty, the worst of all channels."""

    occupied: Bool[np.ndarray, "rows columns"]
    lit: int
    first: int
    end: int
    largest_px: float
    contrast: float


@dataclass(frozen=True)
class SurveyedLight:
    """A picture and what a look at all its pixels told: per tile sums and peaks of its channels, the largest diameter, and
    whether all pixels have light."""

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
        return cls(values, coc_px, sums, peaks, largest_px, least.min(axis=0), is_full)

    @cached_property
    def tiles(self) -> Tiles:
        from mrbokeh.renderers.polygon._tiles_numba import look_over

        occupied, work = np.empty(self.largest_of_tile_px.shape, np.bool_), np.empty((2, self.sums.shape[2]), np.float32)
        lit, first, end, largest_px, contrast = look_over(self.sums, self.peaks, self.largest_of_tile_px, occupied, *work)
        if not largest_px < np.inf:
            raise InputError("every visible pixel needs a finite circle of confusion: depth must be positive (or inf), not 0 or NaN")
        return Tiles(occupied, lit, first, end, largest_px, contrast)

    @property
    def pixels(self) -> int:
        """In tiles that are not empty."""
        from mrbokeh.renderers.polygon._survey_numba import TILE_PX

        return self.tiles.lit * TILE_PX**2

    def highlights(self, from_px: float, pool: Executor) -> Float32[np.ndarray, "_ _"]:
        """How much of each pixel is spread by its exact kernel; empty if there is no highlight."""
        from mrbokeh.renderers.polygon._survey_numba import find_highlights
        from mrbokeh.renderers.polygon._tiles_numba import find_suspects, integrate

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
        """Four channels, the last ones filled up with zeros."""
        if self.values.shape[2] == 4:
            return self
        channels = slice(first, first + 4)
        values, sums = (np.zeros((*each.shape[:2], 4), np.float32) for each in (self.values, self.sums))
        least = np.zeros(4, np.float32)
        count = self.values[..., channels].shape[2]
        values[..., :count], sums[..., :count], least[:count] = self.values[..., channels], self.sums[..., channels], self.least[channels]
        return SurveyedLight(values, self.coc_px, sums, sums, self.largest_of_tile_px, least, self.is_full)
