"""Compiled loops of Laplacian spreadlets: the kernel that every pixel takes, and the tridiagonal sweeps of integration."""

from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit

NONE = -1
_STRETCH_PX = 32
NEAR = 4  # levels that are found by steps


class Limits(NamedTuple):
    """Sizes of blur at which kernels change. borders_px: where each level of those beyond dense_up_to_px begins.

    The last 2 NEAR of the borders are infinitely large.
    """

    sharp_up_to_px: float
    dense_up_to_px: float
    dense_per_px: float
    levels_per_octave: float
    borders_px: np.ndarray
    blocks: int


@njit(cache=True, nogil=True)
def choose_cells(codes: np.ndarray, out: np.ndarray, values: np.ndarray, coc_px: np.ndarray, bright: np.ndarray, limits: Limits) -> bool:
    """Set the code of every pixel's kernel; sharp pixels are copied to out and have none. Returns False if a circle of confusion is not
    finite.

    A code is a level + blocks * kind + 3 * blocks * (in front of the focus); kinds: 0 dense, 1 sparse, 2 whole Laplacian.
    """
    sharp_up_to_px, dense_up_to_px, dense_per_px, levels_per_octave, borders_px, blocks = limits
    height, width, channels = values.shape
    finite = True
    level = 0  # neighbours often have the same: so much logarithms would take longer than all the rest
    for y in range(height):
        for x in range(width):
            lit = False
            for c in range(channels):
                lit = lit or values[y, x, c] != 0
            size = abs(coc_px[y, x]) if lit else np.float32(0)
            codes[y, x] = NONE
            if not np.isfinite(size):
                finite = False
            elif size <= sharp_up_to_px:
                for c in range(channels):
                    out[y, x, c] = values[y, x, c]
            else:
                if size <= dense_up_to_px:
                    code = int(np.rint(size * dense_per_px))
                else:
                    if size < borders_px[max(0, level - NEAR)] or size > borders_px[level + NEAR]:
                        level = min(int(np.log2(size / borders_px[0]) * levels_per_octave), len(borders_px) - 2 * NEAR)
                    while size < borders_px[level]:
                        level -= 1
                    while size >= borders_px[level + 1]:
                        level += 1
                    code = level + (2 * blocks if bright[y, x] else blocks)
                codes[y, x] = code + 3 * blocks if coc_px[y, x] < 0 else code
    return finite


@njit(cache=True, nogil=True)
def mark_used(used: np.ndarray, codes: np.ndarray) -> None:
    """Set used[code] for every code of a picture (H, W) but NONE."""
    for code in codes.flat:
        if code != NONE:
            used[code] = True


@njit(cache=True, nogil=True)
def _mirrored(place: int, length: int) -> int:
    """Return the place inside that a place beyond the border shows, as in a mirror that stands on the last pixel."""
    while (place < 0 or place >= length) and length > 1:
        place = -place if place < 0 else 2 * (length - 1) - place
    return place if length > 1 else 0


@njit(cache=True, nogil=True, error_model="numpy")
def find_outshining(found: np.ndarray, values: np.ndarray, radius_px: int, times: float, first: int, end: int) -> None:
    """Mark the pixels (H, W) of rows first:end that have a channel of values (H, W, C) more than so many times the mean around them.

    Around: a square of 2 radius_px + 1 pixels, beyond the border as in a mirror; its sum goes along with columns and rows.
    """
    height, width, channels = values.shape
    margin, rows = radius_px * channels, values.reshape(height, -1)
    columns, box = np.zeros(rows.shape[1] + 2 * margin), np.empty(rows.shape[1])
    inner = columns[margin : margin + rows.shape[1]]
    limit = times / (2 * radius_px + 1) ** 2
    for y in range(first - radius_px, first + radius_px):
        inner += np.abs(rows[_mirrored(y, height)])
    for y in range(first, end):
        coming, going = rows[_mirrored(y + radius_px, height)], rows[_mirrored(y - radius_px, height)]
        for i in range(len(inner)):
            inner[i] += abs(coming[i])
        _mirror_ends(columns, width, channels, radius_px)
        for c in range(channels):
            box[c] = columns[c : 2 * margin + channels : channels].sum()
        for i in range(channels, len(box)):
            box[i] = box[i - channels] + columns[i + 2 * margin] - columns[i - channels]
        _mark_row(found[y], rows[y], box, limit, channels)
        for i in range(len(inner)):
            inner[i] -= abs(going[i])


@njit(cache=True, nogil=True)
def _mark_row(found: np.ndarray, values: np.ndarray, box: np.ndarray, limit: float, channels: int) -> None:
    """Mark pixels that exceed their limit; stretches without any are passed in vectors."""
    stretch = _STRETCH_PX * channels
    for first in range(0, len(values), stretch):
        here, around, count = values[first : first + stretch], box[first : first + stretch], 0
        for i in range(len(here)):
            count += abs(here[i]) > limit * around[i]
        if count > 0:
            for i in range(len(here)):
                found[(first + i) // channels] |= abs(here[i]) > limit * around[i]


@njit(cache=True, nogil=True)
def _mirror_ends(columns: np.ndarray, width: int, channels: int, radius_px: int) -> None:
    """Fill the margins of a row of pixels."""
    for x in range(-radius_px, 0):
        right = width - 1 - x
        for c in range(channels):
            columns[(x + radius_px) * channels + c] = columns[(_mirrored(x, width) + radius_px) * channels + c]
            columns[(right + radius_px) * channels + c] = columns[(_mirrored(right, width) + radius_px) * channels + c]


@njit(cache=True, nogil=True)
def pivots(diagonal: np.ndarray, height: int) -> np.ndarray:
    """Return (height, modes) reciprocal pivots of Thomas's elimination for rows -u[y-1] + diagonal u[y] - u[y+1].

    diagonal: (modes,), at least 2.
    """
    modes = diagonal.shape[0]
    out = np.empty((height, modes))
    for k in range(modes):
        out[0, k] = 1.0 / diagonal[k]
    for y in range(1, height):
        for k in range(modes):
            out[y, k] = 1.0 / (diagonal[k] - out[y - 1, k])
    return out


@njit(cache=True, nogil=True)
def solve_columns(modes: np.ndarray, pivot: np.ndarray, scale: np.ndarray, first: int, end: int) -> None:
    """Overwrite the right-hand sides modes[:, first:end] (H, K, C), times scale (K,), with the solutions; zero beyond both ends."""
    height, _, channels = modes.shape
    for y in range(height):
        for k in range(first, end):
            factor, onwards = scale[k] * pivot[y, k], pivot[y, k]
            for c in range(channels):
                before = modes[y - 1, k, c] if y > 0 else modes.dtype.type(0)
                modes[y, k, c] = factor * modes[y, k, c] + onwards * before
    for y in range(height - 2, -1, -1):
        for k in range(first, end):
            onwards = pivot[y, k]
            for c in range(channels):
                modes[y, k, c] += onwards * modes[y + 1, k, c]
