"""Compiled searches of mrbokeh.layering.hidden_background: depth edges, mixed edge pixels, and the background behind them.

A place is a pixel's number: row times width plus column.
"""

import math
from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit

_BESIDE = ((0, 1), (1, 0), (1, 1), (1, -1))


class Front(NamedTuple):
    """A brush fire over H W places: seeds (zeros before), and the memory that it takes: squares of distances and queued, both zeros.

    queue: H W + 1.
    """

    seeds: np.ndarray
    squares: np.ndarray
    queue: np.ndarray
    queued: np.ndarray

    @classmethod
    def over(cls, pixels: int) -> "Front":
        return cls(np.zeros(pixels, np.int32), np.zeros(pixels, np.int32), np.empty(pixels + 1, np.int32), np.zeros(pixels, np.bool_))


@njit(cache=True, nogil=True)
def snap(snapped: np.ndarray, coc_px: np.ndarray, lit: np.ndarray, step_px: float, top: int, bottom: int) -> None:
    """Set rows top to bottom of `snapped`: circles of confusion in which no pixel floats between two surfaces, as antialiasing or
    resizing of depth makes them.

    A pixel between two even surfaces, each at most 2 pixels away on opposite sides, takes the nearer value of the two; a highlight does
    not, for lamps do hang in the air.
    """
    height, width = coc_px.shape
    lowest, highest, even_px = np.empty(width + 2, np.float32), np.empty(width + 2, np.float32), np.float32(0.5 * step_px)
    uneven = np.empty(width, np.bool_)
    for y in range(top, bottom):
        for x in range(width):
            snapped[y, x] = coc_px[y, x]
        if y < 3 or y >= height - 3:
            continue
        _extremes_of_columns(lowest, highest, coc_px, y)
        here = coc_px[y]
        for x in range(width):
            low, high = min(min(lowest[x], lowest[x + 1]), lowest[x + 2]), max(max(highest[x], highest[x + 1]), highest[x + 2])
            uneven[x] = max(here[x] - low, high - here[x]) > even_px
        for x in range(3, width - 3):
            if uneven[x] and not lit[y, x]:
                snapped[y, x] = _snapped(coc_px, y, x, step_px)


@njit(cache=True, nogil=True)
def find_rims(rim: np.ndarray, coc_px: np.ndarray, step_px: float, top: int, bottom: int) -> None:
    """Set rows top to bottom of rim (H, W), bool: True if a neighbour is more than `step_px` nearer, so that the pixel may hold some of
    its colour.
    """
    width = coc_px.shape[1]
    lowest, highest, least_px = np.empty(width + 2, np.float32), np.empty(width + 2, np.float32), np.float32(step_px)
    for y in range(top, bottom):
        _extremes_of_columns(lowest, highest, coc_px, y)
        here, found = coc_px[y], rim[y]
        for x in range(width):
            found[x] = here[x] - min(min(lowest[x], lowest[x + 1]), lowest[x + 2]) > least_px


@njit(cache=True, nogil=True)
def _extremes_of_columns(lowest: np.ndarray, highest: np.ndarray, coc_px: np.ndarray, y: int) -> None:
    """Set the least and the greatest value of rows y - 1 to y + 1 of each column, padded by one pixel on either side; the ends are
    repeated.
    """
    height, width = coc_px.shape
    above, here, below = coc_px[max(y - 1, 0)], coc_px[y], coc_px[min(y + 1, height - 1)]
    low, high = lowest[1 : width + 1], highest[1 : width + 1]
    for x in range(width):
        low[x] = min(min(above[x], here[x]), below[x])
        high[x] = max(max(above[x], here[x]), below[x])
    lowest[0], highest[0] = low[0], high[0]
    lowest[width + 1], highest[width + 1] = low[width - 1], high[width - 1]


@njit(cache=True, nogil=True)
def _snapped(coc_px: np.ndarray, y: int, x: int, step_px: float) -> np.float32:
    here, even_px = coc_px[y, x], 0.5 * step_px
    result = here
    for dy, dx in _BESIDE:
        if abs(here - coc_px[y + dy, x + dx]) <= even_px and abs(here - coc_px[y - dy, x - dx]) <= even_px:
            continue
        for before in range(1, 3):
            a, aa = coc_px[y - before * dy, x - before * dx], coc_px[y - (before + 1) * dy, x - (before + 1) * dx]
            if abs(a - aa) > even_px or abs(here - a) <= even_px:
                continue
            for after in range(1, 3):
                b, bb = coc_px[y + after * dy, x + after * dx], coc_px[y + (after + 1) * dy, x + (after + 1) * dx]
                between = (here - a) * (b - here) > 0.0 and abs(b - here) > even_px
                if between and abs(b - bb) <= even_px and abs(b - a) > 2.0 * step_px:
                    result = a if abs(here - a) < abs(b - here) else b
    return result


LARGEST_SHARE = 0.6


@njit(cache=True, nogil=True)
def unmix_rims(
    front: np.ndarray,
    front_coc_px: np.ndarray,
    behind: np.ndarray,
    rims: np.ndarray,
    of_behind: np.ndarray,
    values: np.ndarray,
    coc_px: np.ndarray,
    lit: np.ndarray,
    step_px: float,
) -> None:
    """Split rim pixels into what the nearer neighbour gave, in front, and the rest, which replaces what was filled in behind.

    rims: (R,) places. front: (R, C), the pixels before; behind: (N, C), at of_behind (R,) what was filled in. The nearer neighbour that
    differs most from the filled-in colour counts, being the least mixed itself. Its share is the one that explains the pixel best as a
    mixture of the two, less the worse that explanation is, and at most 0.6, because the pixel's own depth is the one behind. A pixel
    brighter than that neighbour is no mixture (a lamp behind a wire) and stays whole. Front and rest together are the pixel: no light is
    lost.
    """
    width, channels = values.shape[1:]
    for i in range(len(rims)):
        y, x, filled = rims[i] // width, rims[i] % width, behind[of_behind[i]]
        fy, fx, most = _most_different(values, coc_px, y, x, filled, step_px)
        if fy < 0 or (lit[y, x] and not _lamp_in_front(values, coc_px, y, x, step_px)):
            continue
        along, off = 0.0, 0.0
        for c in range(3):
            along += (values[y, x, c] - filled[c]) * (values[fy, fx, c] - filled[c])
            off += (values[y, x, c] - filled[c]) ** 2
        if along > most:
            continue
        explained = along * along / (most * off) if off > 0.0 and along > 0.0 else 0.0
        share = min(LARGEST_SHARE, explained * along / most)
        front_coc_px[i] = coc_px[fy, fx]
        for c in range(channels):
            rest = (values[y, x, c] - share * values[fy, fx, c]) / (1.0 - share)
            filled[c] = max(0.0, rest) if c < 3 else rest
            front[i, c] = values[y, x, c] - (1.0 - share) * filled[c]
        front[i, 3], filled[3] = share, 1.0


@njit(cache=True, nogil=True)
def _most_different(values: np.ndarray, coc_px: np.ndarray, y: int, x: int, filled: np.ndarray, step_px: float) -> tuple[int, int, float]:
    """Return row and column of the nearer neighbour whose colour differs most from the filled-in background, and the squared difference;
    rows -1 if there is none.
    """
    height, width, _ = values.shape
    fy, fx, most = -1, -1, 0.0
    for ny in range(max(0, y - 1), min(height, y + 2)):
        for nx in range(max(0, x - 1), min(width, x + 2)):
            if coc_px[ny, nx] < coc_px[y, x] - step_px:
                difference = 0.0
                for c in range(3):
                    difference += (values[ny, nx, c] - filled[c]) ** 2
                if difference > most:
                    fy, fx, most = ny, nx, difference
    return fy, fx, most


@njit(cache=True, nogil=True)
def _lamp_in_front(values: np.ndarray, coc_px: np.ndarray, y: int, x: int, step_px: float) -> bool:
    """Return whether the brightest of the 5x5 pixels around, the highlight whose light the pixel holds, is nearer than the pixel."""
    height, width, _ = values.shape
    brightest, nearer = -1.0, False
    for ny in range(max(0, y - 2), min(height, y + 3)):
        for nx in range(max(0, x - 2), min(width, x + 3)):
            brightness = values[ny, nx, 0] + values[ny, nx, 1] + values[ny, nx, 2]
            if brightness > brightest:
                brightest, nearer = brightness, coc_px[ny, nx] < coc_px[y, x] - step_px
    return nearer


@njit(cache=True, nogil=True)
def pure_neighbours(places: np.ndarray, coc_px: np.ndarray, pure: np.ndarray, step_px: float, radius_px: int) -> np.ndarray:
    """Return for each mixed pixel of `places` the place of the nearest pure pixel of the same surface; -1 if none is within `radius_px`."""
    height, width = coc_px.shape
    nearest = np.full(len(places), -1, np.int32)
    for i in range(len(places)):
        y, x = places[i] // width, places[i] % width
        least = (radius_px + 1) ** 2
        for ny in range(max(0, y - radius_px), min(height, y + radius_px + 1)):
            for nx in range(max(0, x - radius_px), min(width, x + radius_px + 1)):
                distance = (ny - y) ** 2 + (nx - x) ** 2
                if distance < least and pure[ny, nx] and abs(coc_px[ny, nx] - coc_px[y, x]) <= step_px:
                    least = distance
                    nearest[i] = ny * width + nx
    return nearest


@njit(cache=True, nogil=True)
def nearest_behind(front: Front, coc_px: np.ndarray, rims: np.ndarray, pure: np.ndarray, step_px: float) -> None:
    """Set the seeds of the front to one plus the place of the nearest pure pixel that lies more than `step_px` behind.

    Where the lens sees none they stay 0. rims: places of rim pixels; pure: the pure pixel beside each, or -1.
    The lens sees past an edge by half the difference of the two circles of confusion (and a rim's width more is searched).
    A brush fire from the edges inwards; the condition differs from pixel to pixel, and a seed travels only through pixels
    that it lies behind, so that a nearer one can be missed by a pixel or two where several depths meet.
    """
    width = coc_px.shape[1]
    # Of one type wherever it is called from, `_pass_on` is compiled once.
    first, end = np.int64(0), np.int64(0)
    for i in range(len(rims)):
        if pure[i] >= 0:
            place = np.int64(rims[i])
            nearer_px = np.float64(coc_px[place // width, place % width] - step_px)
            end = _pass_on(front, end, coc_px, place, np.int64(pure[i]), nearer_px, step_px)
    while first != end:
        place = np.int64(front.queue[first])
        first = (first + 1) % front.queue.size
        front.queued[place] = False
        end = _pass_on(front, end, coc_px, place, np.int64(front.seeds[place] - 1), np.inf, step_px)


@njit(cache=True, nogil=True)
def _pass_on(front: Front, end: int, coc_px: np.ndarray, place: int, seed: int, nearer_px: float, step_px: float) -> int:
    """Offer a seed to the pixels around a place whose circle of confusion is below `nearer_px`, and return the new end of the queue. A
    pixel takes the seed and is queued if the seed lies behind it, within sight, and nearer than the seed that it has.
    """
    seeds, squares, queue, queued = front
    height, width = coc_px.shape
    y, x, sy, sx = place // width, place % width, seed // width, seed % width
    seed_px = coc_px[sy, sx]
    for ny in range(max(0, y - 1), min(height, y + 2)):
        for nx in range(max(0, x - 1), min(width, x + 2)):
            behind_px, there = seed_px - coc_px[ny, nx], ny * width + nx
            if coc_px[ny, nx] >= nearer_px or behind_px <= step_px:
                continue
            square = (sy - ny) ** 2 + (sx - nx) ** 2
            if (squares[there] > 0 and square >= squares[there]) or square > (0.5 * behind_px + 3.5) ** 2:
                continue
            seeds[there], squares[there] = seed + 1, square
            if not queued[there]:
                queue[end], queued[there] = there, True
                end = (end + 1) % queue.size
    return end


@njit(cache=True, nogil=True, inline="always")
def _is_on(coc_px: np.ndarray, y: int, x: int, surface_coc_px: float, surface_px: float) -> bool:
    """Return whether (y, x) is a pixel that lies on the surface with this circle of confusion."""
    return 0 <= y < coc_px.shape[0] and 0 <= x < coc_px.shape[1] and abs(coc_px[y, x] - surface_coc_px) <= surface_px


@njit(cache=True, nogil=True)
def interpolate(
    filled: np.ndarray,
    filled_coc_px: np.ndarray,
    places: np.ndarray,
    seeds: np.ndarray,
    values: np.ndarray,
    coc_px: np.ndarray,
    paths: np.ndarray,
    surface_px: float,
    first: int,
    end: int,
) -> None:
    """Set filled (N, C) and its circles of confusion, first to end, from the pixels around each place that lie on its seed's surface.

    They are the first pure pixels (mixed ones have coc_px NaN) along 8 paths, up to twice as far as the seed, weighted by one over the
    squared distance; each path gives the mean of a quarter as many pixels as the first is far. So behind a thin wire this interpolates
    between both sides, and behind a broad object it continues what is beside it, ever smoother, as a guess should be.
    """
    width, channels = values.shape[1:]
    for i in range(first, end):
        y, x, sy, sx = places[i] // width, places[i] % width, seeds[i] // width, seeds[i] % width
        nearest_px, seed_px = math.sqrt((sy - y) ** 2 + (sx - x) ** 2), coc_px[sy, sx]
        total = 1.0 / max(nearest_px, 0.5) ** 2
        coc_sum = total * seed_px
        for c in range(channels):
            filled[i, c] = total * values[sy, sx, c]
        for path in range(len(paths)):
            near, farthest = 1, int(2.0 * nearest_px + 3.0)
            while near < farthest and not _is_on(coc_px, y + paths[path, near, 0], x + paths[path, near, 1], seed_px, surface_px):
                near += 1
            weight = 1.0 / (near**2 * max(1, near // 4))
            for distance in range(near, near + max(1, near // 4)):
                ny, nx = y + paths[path, distance, 0], x + paths[path, distance, 1]
                if not _is_on(coc_px, ny, nx, seed_px, surface_px):
                    break
                total += weight
                coc_sum += weight * coc_px[ny, nx]
                for c in range(channels):
                    filled[i, c] += weight * values[ny, nx, c]
        filled_coc_px[i] = coc_sum / total
        for c in range(channels):
            filled[i, c] /= total
