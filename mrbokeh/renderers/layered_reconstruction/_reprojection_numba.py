"""Reprojection of the samples around a tile along the slopes of one partition (Eq. 1)."""

import math

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def reproject(
    planes: np.ndarray,
    left: int,
    top: int,
    pupil_radius: float,
    slope: tuple[float, float, float],
    span: np.ndarray,
    light: tuple,
) -> None:
    """Add to planes (h, w, C + 2), whose top left pixel is (left, top), colour, opacity and weight.

    A sample within the span of buckets adds its values, an opacity of 1 and a weight of 1. One behind it adds a weight
    only: it was seen through this place. One in front says nothing.
    slope: a, b_x, b_y. light: samples sorted by tile: geometry, values, bucket, starts, then columns of tiles and their side.
    """
    geometry, values, bucket, starts, columns, tile_px = light
    reach_x = abs(slope[0]) * pupil_radius + 0.5 * abs(slope[1])
    reach_y = abs(slope[0]) * pupil_radius + 0.5 * abs(slope[2])
    height, width, channels = planes.shape
    channels -= 2
    rows = (len(starts) - 1) // columns
    first_column = max(0, int(math.floor((left - reach_x) / tile_px)))
    last_column = min(columns - 1, int(math.floor((left + width + reach_x) / tile_px)))
    first_row = max(0, int(math.floor((top - reach_y) / tile_px)))
    last_row = min(rows - 1, int(math.floor((top + height + reach_y) / tile_px)))
    a, b_x, b_y = np.float32(slope[0]), np.float32(slope[1]), np.float32(slope[2])
    front, behind = span[0], span[1]
    off_x, off_y = np.float32(left), np.float32(top)
    for row in range(first_row, last_row + 1):
        for i in range(starts[row * columns + first_column], starts[row * columns + last_column + 1]):
            if bucket[i] < front:
                continue
            x = geometry[i, 0] - a * geometry[i, 2] - b_x * geometry[i, 4] - off_x
            y = geometry[i, 1] - a * geometry[i, 3] - b_y * geometry[i, 4] - off_y
            if not (0.0 <= x < width and 0.0 <= y < height):
                continue
            place = planes[int(y), int(x)]
            place[channels + 1] += np.float32(1.0)
            if bucket[i] <= behind:
                place[channels] += np.float32(1.0)
                for c in range(channels):
                    place[c] += values[i, c]


@njit(cache=True, nogil=True)
def even_out(planes: np.ndarray, enough: float) -> None:
    """Let no place of planes (h, w, C + 2) weigh more than `enough` samples do, with its colour and opacity kept in proportion.

    Samples fall on places in uneven numbers by chance. Left so, that chance is noise in every mean over places.
    """
    height, width, channels = planes.shape
    for y in range(height):
        for x in range(width):
            place = planes[y, x]
            if place[channels - 1] > enough:
                share = np.float32(enough) / place[channels - 1]
                for c in range(channels):
                    place[c] *= share
