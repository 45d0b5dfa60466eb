"""Compiled loops of mrbokeh.depth.mended_depth: edges of depth made hard, sides told by colour, and what a blur took given back.

All but `flow` work on rows top to bottom, so that bands of a picture may run side by side; none depends on where a band ends. Values grow
with nearness, and two that differ by no more than `jump` belong to one surface.
"""

import math

import numpy as np

from mrbokeh.system.compiled import njit

_FAR_AWAY = 99.0
_ROUND = np.float32(0.03)
_UNLIKE, _BESIDE, _DIAGONAL, _HALF = np.float32(44.0), np.float32(1.0), np.float32(0.7), np.float32(0.5)
"""Neighbours count about exp(-44 d), d the square of the difference of their colours; those at a corner less."""


@njit(cache=True, nogil=True)
def steepen(out: np.ndarray, values: np.ndarray, bend: np.ndarray, at_edge: np.ndarray, top: int, bottom: int) -> None:
    """Set rows of out: at edges the greatest of 3x3 values where the surface bends down (bend < 0), else the least."""
    height, width = values.shape
    for y in range(top, bottom):
        for x in range(width):
            best = values[y, x]
            if at_edge[y, x]:
                rises = bend[y, x] < 0.0
                for v in range(max(y - 1, 0), min(y + 2, height)):
                    for u in range(max(x - 1, 0), min(x + 2, width)):
                        best = max(best, values[v, u]) if rises else min(best, values[v, u])
            out[y, x] = best


@njit(cache=True, nogil=True)
def other_side(
    other: np.ndarray, away_px: np.ndarray, values: np.ndarray, uneven: np.ndarray, jump: float, reach_px: int, top: int, bottom: int
) -> None:
    """Set rows of other, the value of the nearest pixel of another surface within reach, and of away_px, how far that is (99: none).

    uneven: where to look.
    """
    height, width = values.shape
    for y in range(top, bottom):
        for x in range(width):
            here = values[y, x]
            other[y, x], away_px[y, x] = here, _FAR_AWAY
            if not uneven[y, x]:
                continue
            least = reach_px * reach_px + 1
            for v in range(max(y - reach_px, 0), min(y + reach_px + 1, height)):
                for u in range(max(x - reach_px, 0), min(x + reach_px + 1, width)):
                    square = (v - y) * (v - y) + (u - x) * (u - x)
                    if square < least and abs(values[v, u] - here) > jump:
                        least = square
                        other[y, x], away_px[y, x] = values[v, u], math.sqrt(square)


@njit(cache=True, nogil=True)
def mark_sure(sure: np.ndarray, values: np.ndarray, away_px: np.ndarray, jump: float, reach_px: int, top: int, bottom: int) -> None:
    """Set rows of sure: what lies farther than reach_px from another surface, or in the middle of a thin thing."""
    height, width = values.shape
    for y in range(top, bottom):
        for x in range(width):
            deepest = min(away_px[y, x], reach_px + 1.0)
            if away_px[y, x] <= reach_px:
                for v in range(max(y - reach_px, 0), min(y + reach_px + 1, height)):
                    for u in range(max(x - reach_px, 0), min(x + reach_px + 1, width)):
                        if abs(values[v, u] - values[y, x]) <= jump:
                            deepest = max(deepest, min(away_px[v, u], reach_px + 1.0))
            sure[y, x] = away_px[y, x] >= deepest - 0.01


@njit(cache=True, nogil=True)
def likeness(
    like: np.ndarray,
    rgb: np.ndarray,
    values: np.ndarray,
    other: np.ndarray,
    away_px: np.ndarray,
    sure: np.ndarray,
    window_px: int,
    per_step: np.float32,
    top: int,
    bottom: int,
) -> None:
    """Set rows of like: from 1, the pixel has the colour of its own side, to -1, that of the other; 0 where nothing tells.

    Each side is stood for by its sure pixel within the window that is the most alike: surfaces have textures of several colours.
    away_px: how far the other side is, 99 where nobody asks. per_step: what a pixel of distance, squared, adds to the square of a
    difference of colours.
    """
    height, width = values.shape
    for y in range(top, bottom):
        for x in range(width):
            like[y, x] = 0.0
            if away_px[y, x] >= _FAR_AWAY:
                continue
            mine, others = values[y, x], other[y, x]
            most, nearest, next_to = 0.5 * abs(mine - others), np.float32(9.0), np.float32(9.0)
            red, green, blue = rgb[y, x, 0], rgb[y, x, 1], rgb[y, x, 2]
            for v in range(max(y - window_px, 0), min(y + window_px + 1, height)):
                for u in range(max(x - window_px, 0), min(x + window_px + 1, width)):
                    if not sure[v, u] or (u == x and v == y):
                        continue
                    to_mine, to_others = abs(values[v, u] - mine), abs(values[v, u] - others)
                    if min(to_mine, to_others) > most:
                        continue
                    r, g, b = rgb[v, u, 0] - red, rgb[v, u, 1] - green, rgb[v, u, 2] - blue
                    square = r * r + g * g + b * b + per_step * ((v - y) * (v - y) + (u - x) * (u - x))
                    if to_mine < to_others:
                        nearest = min(nearest, square)
                    else:
                        next_to = min(next_to, square)
            if nearest < 9.0 and next_to < 9.0:
                a, b = math.sqrt(nearest), math.sqrt(next_to)
                like[y, x] = (b - a) / (b + a + _ROUND)


@njit(cache=True, nogil=True)
def vote(
    out: np.ndarray,
    values: np.ndarray,
    rgb: np.ndarray,
    own: np.ndarray,
    other: np.ndarray,
    like: np.ndarray,
    may: np.ndarray,
    weight: float,
    top: int,
    bottom: int,
) -> None:
    """Set rows of out: where a pixel may change its side, own or other, by its likeness and its 8 neighbours, those of its colour most."""
    height, width = values.shape
    for y in range(top, bottom):
        for x in range(width):
            if not may[y, x]:
                out[y, x] = values[y, x]
                continue
            total = like[y, x]
            for v in range(max(y - 1, 0), min(y + 2, height)):
                for u in range(max(x - 1, 0), min(x + 2, width)):
                    if u == x and v == y:
                        continue
                    r, g, b = rgb[v, u, 0] - rgb[y, x, 0], rgb[v, u, 1] - rgb[y, x, 1], rgb[v, u, 2] - rgb[y, x, 2]
                    unlike = _UNLIKE * (r * r + g * g + b * b)
                    says = weight * (_DIAGONAL if u != x and v != y else _BESIDE) / (_BESIDE + unlike + _HALF * unlike * unlike)
                    total += says if abs(values[v, u] - own[y, x]) < abs(values[v, u] - other[y, x]) else -says
            out[y, x] = own[y, x] if total >= 0.0 else other[y, x]


@njit(cache=True, nogil=True)
def shares(share: np.ndarray, values: np.ndarray, band: np.ndarray, taps: np.ndarray, jump: float, top: int, bottom: int) -> None:
    """Set rows of share: the part of a blur (taps, square) around each pixel that lies on its own surface; 1 outside the band."""
    height, width = values.shape
    reach = taps.shape[0] // 2
    for y in range(top, bottom):
        for x in range(width):
            share[y, x] = 1.0
            if not band[y, x]:
                continue
            total = 0.0
            for dy in range(-reach, reach + 1):
                v = min(max(y + dy, 0), height - 1)
                for dx in range(-reach, reach + 1):
                    u = min(max(x + dx, 0), width - 1)
                    if abs(values[v, u] - values[y, x]) <= jump:
                        total += taps[dy + reach, dx + reach]
            share[y, x] = total


@njit(cache=True, nogil=True)
def give_back(
    out: np.ndarray,
    values: np.ndarray,
    left: np.ndarray,
    share: np.ndarray,
    band: np.ndarray,
    taps: np.ndarray,
    jump: float,
    top: int,
    bottom: int,
) -> None:
    """Set rows of out: values moved so that, blurred, they leave less of `left`, what is missing now. Each surface moves as one around a
    pixel: by least squares, weighted by the taps.
    """
    height, width = values.shape
    reach = taps.shape[0] // 2
    for y in range(top, bottom):
        for x in range(width):
            out[y, x] = values[y, x]
            if not band[y, x]:
                continue
            missing, counts = 0.0, 0.0
            for dy in range(-reach, reach + 1):
                v = min(max(y + dy, 0), height - 1)
                for dx in range(-reach, reach + 1):
                    u = min(max(x + dx, 0), width - 1)
                    if abs(values[v, u] - values[y, x]) <= jump:
                        weight = taps[dy + reach, dx + reach] * share[v, u]
                        missing += weight * left[v, u]
                        counts += weight * share[v, u]
            out[y, x] = values[y, x] + missing / max(counts, 0.1)


@njit(cache=True, nogil=True)
def settle(
    out: np.ndarray, values: np.ndarray, share: np.ndarray, band: np.ndarray, reach_px: int, jump: float, top: int, bottom: int
) -> None:
    """Set rows of out: in the band the mean of the surface around each pixel; what the blur left more of counts more."""
    height, width = values.shape
    for y in range(top, bottom):
        for x in range(width):
            out[y, x] = values[y, x]
            if not band[y, x] or share[y, x] > _WHOLE:
                continue
            total, counts = 0.0, 0.0
            for v in range(max(y - reach_px, 0), min(y + reach_px + 1, height)):
                for u in range(max(x - reach_px, 0), min(x + reach_px + 1, width)):
                    if abs(values[v, u] - values[y, x]) <= jump:
                        weight = share[v, u] * share[v, u] * share[v, u]
                        total += weight * values[v, u]
                        counts += weight
            out[y, x] = total / counts


_WHOLE = np.float32(0.95)
_STEP, _COLOUR_STEP, _LEVELS = 1, 60.0, 512
_SIDES = ((0, 1), (1, 0), (0, -1), (-1, 0))


@njit(cache=True, nogil=True)
def flow(values: np.ndarray, known: np.ndarray, rgb: np.ndarray) -> None:
    """Fill values where they are not known from the known pixel on the cheapest way: each step costs 1 and the change of colour.

    Dijkstra's search with whole costs in a ring of buckets.
    """
    height, width = values.shape
    cost = np.where(known, 0, 2**30).astype(np.int32).ravel()
    # A place waits once for each way that was cheaper than all before; when a dearer one comes up it is passed over.
    most = 4 * (known.size - np.count_nonzero(known)) + known.size
    places, following, first = np.empty(most, np.int32), np.empty(most, np.int32), np.full(_LEVELS, -1, np.int32)
    count, waiting = 0, 0
    for y in range(height):
        for x in range(width):
            if known[y, x] and _beside_hole(known, y, x):
                places[count], following[count], first[0] = y * width + x, first[0], count
                count, waiting = count + 1, waiting + 1
    level = 0
    while waiting > 0:
        bucket = level % _LEVELS
        while first[bucket] >= 0:
            place, first[bucket] = places[first[bucket]], following[first[bucket]]
            waiting -= 1
            if cost[place] != level:
                continue
            y, x = place // width, place % width
            for dy, dx in _SIDES:
                v, u = y + dy, x + dx
                if v < 0 or u < 0 or v >= height or u >= width or known[v, u]:
                    continue
                r, g, b = rgb[v, u, 0] - rgb[y, x, 0], rgb[v, u, 1] - rgb[y, x, 1], rgb[v, u, 2] - rgb[y, x, 2]
                there = level + _STEP + min(int(_COLOUR_STEP * math.sqrt(r * r + g * g + b * b)), _LEVELS - 2)
                if there < cost[v * width + u]:
                    cost[v * width + u], values[v, u] = there, values[y, x]
                    places[count], following[count], first[there % _LEVELS] = v * width + u, first[there % _LEVELS], count
                    count, waiting = count + 1, waiting + 1
        level += 1


@njit(cache=True, nogil=True)
def _beside_hole(known: np.ndarray, y: int, x: int) -> bool:
    height, width = known.shape
    return (
        (y > 0 and not known[y - 1, x])
        or (x > 0 and not known[y, x - 1])
        or (y < height - 1 and not known[y + 1, x])
        or (x < width - 1 and not known[y, x + 1])
    )
