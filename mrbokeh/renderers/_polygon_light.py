"""What polygon_differences learns from one look at all pixels, before it spreads them."""

from concurrent.futures import Executor
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.errors import InputError

NO_HIGHLIGHTS = np.zeros((0, 0), np.float32)
_ROWS_AT_ONCE = 24


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
        from mrbokeh.renderers._polygon_survey_numba import TILE_PX, survey

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

    @property
    def largest_px(self) -> float:
        largest = float(self.largest_of_tile_px.max(initial=0.0))
        if not np.isfinite(largest):
            raise InputError("every visible pixel needs a finite circle of confusion: depth must be positive (or inf), not 0 or NaN")
        return largest

    @property
    def pixels(self) -> int:
        """In tiles that are not empty."""
        from mrbokeh.renderers._polygon_survey_numba import TILE_PX

        return int(np.any(self.sums > 0, axis=2).sum()) * TILE_PX**2

    @property
    def contrast(self) -> float:
        """The strongest value of a channel over the mean of its darkest tile that is not empty; the worst of all channels."""
        from mrbokeh.renderers._polygon_survey_numba import TILE_PX

        darkest = np.where(self.sums > 0, self.sums, np.inf).min(axis=(0, 1)) / TILE_PX**2
        return float((self.peaks.max(axis=(0, 1)) / darkest).max(initial=0.0))

    def highlights(self, from_px: float, pool: Executor) -> Float32[np.ndarray, "_ _"]:
        """How much of each pixel is spread by its exact kernel; empty if there is no highlight."""
        from mrbokeh.renderers._polygon_survey_numba import HIGHLIGHT, find_highlights

        suspect = ((self.peaks > HIGHLIGHT * self.sums).any(axis=2)) & (self.largest_of_tile_px > from_px)
        if not suspect.any():
            return NO_HIGHLIGHTS
        integral = np.zeros((suspect.shape[0] + 1, suspect.shape[1] + 1, self.sums.shape[2]))
        integral[1:, 1:] = self.sums.cumsum(axis=0, dtype=np.float64).cumsum(axis=1)
        share = np.zeros(self.coc_px.shape, np.float32)
        tiles = np.argwhere(suspect)
        pieces = np.array_split(tiles, -(-len(tiles) // 256))
        list(pool.map(lambda piece: find_highlights(self.values, self.coc_px, piece, integral, from_px, share), pieces))
        return share if share.any() else NO_HIGHLIGHTS

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
