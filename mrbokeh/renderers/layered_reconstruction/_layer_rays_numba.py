"""Compiled rays through pupil and shutter into layers with depth: each meets one pixel of one layer, or nothing."""

import math
from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit

_THICKNESS_PX = 1.0
_FIXED_POINT_ROUNDS = 3
_GOLDEN = 1.1673039782614187  # the root of g^6 = g + 1: the steps of an even sequence in five dimensions (Roberts 2018)


class Pupil(NamedTuple):
    """Spans of the pupil before the focus and behind it, from side_starts, with running weights and the heights of their strips."""

    spans: np.ndarray
    cumulative: np.ndarray
    side_starts: np.ndarray
    heights: np.ndarray


class Surfaces(NamedTuple):
    """Layers, front first: radius_px, alpha (L, H, W), motion_px (L, H, W, 2), fastest_px the fastest around each pixel.

    ranges_px (L, 2): the least and largest radius. is_opaque: a ray that meets nothing has passed behind an edge, and what lies behind
    goes on there.
    """

    radius_px: np.ndarray
    alpha: np.ndarray
    motion_px: np.ndarray
    fastest_px: np.ndarray
    ranges_px: np.ndarray
    is_opaque: bool


class Samples(NamedTuple):
    """Rays and hits. met: (N, 3) layer, row, column; -1 where a ray meets nothing."""

    xy_px: np.ndarray
    lens_uv: np.ndarray
    time: np.ndarray
    met: np.ndarray


@njit(cache=True, nogil=True)
def shifts(pixel: int, seed: int, out: np.ndarray) -> None:
    """Set chance in [0, 1) for each dimension of a pixel, by xor-shift from a mixed start."""
    state = (pixel * 2654435761 + seed * 2246822519 + 374761393) & 0xFFFFFFFF
    state = state if state else 1
    for k in range(-3, len(out)):
        state ^= (state << 13) & 0xFFFFFFFF
        state ^= state >> 17
        state ^= (state << 5) & 0xFFFFFFFF
        if k >= 0:
            out[k] = state / 4294967296.0


@njit(cache=True, nogil=True)
def through_pupil(spans: np.ndarray, cumulative: np.ndarray, height: float, first: float, second: float) -> tuple[float, float]:
    """Return a place in the pupil for two numbers in [0, 1): strips (S, 5) of one height, with the running sums of their weights."""
    k = 0
    while k < len(cumulative) - 1 and cumulative[k] <= first:
        k += 1
    before = cumulative[k - 1] if k > 0 else 0.0
    within = (first - before) / max(cumulative[k] - before, 1e-12)
    return spans[k, 1] + second * (spans[k, 2] - spans[k, 1]), spans[k, 0] + (within - 0.5) * height


@njit(cache=True, nogil=True)
def carried_to(x: float, y: float, m_x: float, m_y: float, covered: np.ndarray, motion_px: np.ndarray, tau: float) -> tuple[int, int, bool]:
    """Return row and column of the pixel that lies at (x, y) at the time tau, beginning with a motion, and whether its own brings it there.

    -1 outside the picture.
    """
    height, width = covered.shape
    row, column = -1, -1
    for _ in range(_FIXED_POINT_ROUNDS):
        column, row = int(math.floor(x - m_x * tau)), int(math.floor(y - m_y * tau))
        if not (0 <= column < width and 0 <= row < height):
            return -1, -1, False
        own_x, own_y = motion_px[row, column, 0], motion_px[row, column, 1]
        off_px = abs(tau) * max(abs(own_x - m_x), abs(own_y - m_y))
        if covered[row, column] > 0.0 and off_px < 0.5:
            return row, column, True
        m_x, m_y = own_x, own_y
    return row, column, False


@njit(cache=True, nogil=True)
def pinhole_place(
    x: float, y: float, radius_px: np.ndarray, covered: np.ndarray, motion_px: np.ndarray, fastest_px: np.ndarray, tau: float
) -> tuple[int, int]:
    """Return row and column of the pixel of a layer that lies at (x, y) at the time tau, or -1.

    It begins with the motion at that place and with the fastest around it, fastest_px, since a moving pixel covers places that it does
    not cover at half time. Of two pixels that come there the nearer counts.
    """
    at_row, at_column = min(max(int(math.floor(y)), 0), covered.shape[0] - 1), min(max(int(math.floor(x)), 0), covered.shape[1] - 1)
    own, fastest = motion_px[at_row, at_column], fastest_px[at_row, at_column]
    row, column, comes = carried_to(x, y, own[0], own[1], covered, motion_px, tau)
    if own[0] == fastest[0] and own[1] == fastest[1]:
        return row, column
    other_row, other_column, other_comes = carried_to(x, y, fastest[0], fastest[1], covered, motion_px, tau)
    if other_comes and not (comes and radius_px[row, column] <= radius_px[other_row, other_column]):
        return other_row, other_column
    return row, column


@njit(cache=True, nogil=True)
def meet(
    x: float, y: float, pupils: np.ndarray, tau: float, radius_px: np.ndarray, covered: np.ndarray, motion_px: np.ndarray,
    fastest_px: np.ndarray, range_px: np.ndarray, fill: bool,
) -> tuple[int, int, int]:  # fmt: skip
    """Return row, column and side (0 in front of the focus, 1 behind) of the pixel that a ray meets in one layer; -1 where it meets none.

    The ray is followed from what is nearest to what is farthest: a point of signed blur radius s on it lies at x - s u.
    It meets the surface where that falls to s; where it already lies a pixel before, the ray passes behind an edge.
    fill: a ray that meets nothing then meets the last pixel that lay behind it, as if that went on behind the edge.
    pupils: (2, 2) u, v for what is in front of the focus and behind it. range_px: the least and the largest signed radius of the layer.
    """
    nearest_px, farthest_px = range_px
    longest = max(math.hypot(pupils[0, 0], pupils[0, 1]), math.hypot(pupils[1, 0], pupils[1, 1]), 1e-3)
    steps = max(1, int(math.ceil((farthest_px - nearest_px) * longest * 2.0)))
    step = (farthest_px - nearest_px) / steps
    last_row, last_column, last_side = -1, -1, 0
    for k in range(steps + 1):
        s = nearest_px + k * step
        side = 1 if s > 0.0 else 0
        row, column = pinhole_place(x - s * pupils[side, 0], y - s * pupils[side, 1], radius_px, covered, motion_px, fastest_px, tau)
        if row < 0 or covered[row, column] <= 0.0:
            continue
        before = s - radius_px[row, column]
        if -0.5 * step - 1e-6 <= before <= max(_THICKNESS_PX, step):
            # There the ray is up to a step away from the surface; what counts is the pixel at that pixel's own depth.
            own = radius_px[row, column]
            side = 1 if own > 0.0 else 0
            row, column = pinhole_place(
                x - own * pupils[side, 0], y - own * pupils[side, 1], radius_px, covered, motion_px, fastest_px, tau
            )
            if row >= 0 and covered[row, column] > 0.0 and abs(radius_px[row, column] - own) <= _THICKNESS_PX:
                return row, column, side
            continue
        if before < 0.0:
            last_row, last_column, last_side = row, column, 1 if radius_px[row, column] > 0.0 else 0
    return (last_row, last_column, last_side) if fill else (-1, -1, 0)


@njit(cache=True, nogil=True)
def trace_rows(top: int, bottom: int, width: int, per_pixel: int, seed: int, pupil: Pupil, surfaces: Surfaces, samples: Samples) -> None:
    """Fill per_pixel samples of each pixel of rows top to bottom. A layer of coverage alpha stops that share of the rays."""
    spans, cumulative, side_starts, heights = pupil
    radius_px, alpha, motion_px, fastest_px, ranges_px, is_opaque = surfaces
    xy_px, lens_uv, time, met = samples
    layers = len(alpha)
    chance, pupils = np.empty(5 + layers), np.empty((2, 2))
    for y in range(top, bottom):
        for x in range(width):
            shifts(y * width + x, seed, chance)
            for n in range(per_pixel):
                i = (y * width + x) * per_pixel + n
                place_x, place_y = x + even(chance[0], n, 1), y + even(chance[1], n, 2)
                first, second, at = even(chance[2], n, 3), even(chance[3], n, 4), even(chance[4], n, 5)
                for side in range(2):
                    own = slice(side_starts[side], side_starts[side + 1])
                    u, v = through_pupil(spans[own], cumulative[own], heights[side], first, second)
                    pupils[side, 0], pupils[side, 1] = u, v
                met[i, 0], side = -1, 1
                for trial in range(2 if is_opaque else 1):
                    for layer in range(layers):
                        if met[i, 0] >= 0:
                            break
                        row, column, side = meet(
                            place_x, place_y, pupils, at - 0.5, radius_px[layer], alpha[layer], motion_px[layer],
                            fastest_px[layer],
                            ranges_px[layer], trial == 1,
                        )  # fmt: skip
                        if row >= 0 and (chance[5 + layer] + n * 0.6180339887498949) % 1.0 < alpha[layer, row, column]:
                            met[i, 0], met[i, 1], met[i, 2] = layer, row, column
                xy_px[i, 0], xy_px[i, 1] = min(place_x, x + 0.99999), min(place_y, y + 0.99999)
                lens_uv[i, 0], lens_uv[i, 1] = pupils[side, 0], pupils[side, 1]
                time[i] = at


@njit(cache=True, nogil=True)
def even(shift: float, n: int, dimension: int) -> float:
    """Return the n-th number of an even sequence of five dimensions, shifted, in [0, 1)."""
    return (shift + n * _GOLDEN ** (-dimension)) % 1.0
