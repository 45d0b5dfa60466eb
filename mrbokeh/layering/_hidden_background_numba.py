"""The searches of mrbokeh.layering.hidden_background, compiled. Pixels are called by place: row times width plus column."""

import math

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True, nogil=True)
def pure_neighbours(places: np.ndarray, coc_px: np.ndarray, pure: np.ndarray, step_px: float, radius_px: int) -> np.ndarray:
    """For each of the places, not pure itself, the nearest pure pixel of the same surface; -1 where none is within `radius_px`."""
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
def nearest_behind(
    seeds: np.ndarray,
    squares: np.ndarray,
    queue: np.ndarray,
    queued: np.ndarray,
    coc_px: np.ndarray,
    rims: np.ndarray,
    pure: np.ndarray,
    step_px: float,
) -> None:
    """Set seeds (H W, zeros before) to one more than the place of the nearest pure pixel that lies more than `step_px` behind.

    Where the lens sees none they stay 0. rims: places of rim pixels; pure: the pure pixel beside each, or -1.
    The lens sees past an edge by half the difference of the two circles of confusion (and a rim's width more is searched).
    A brush fire from the edges inwards; the condition differs from pixel to pixel, and a seed travels only through pixels
    that it lies behind, so that a nearer one can be missed by a pixel or two where several depths meet.
    squares (H W) of distances and queued (H W), both zeros, and queue (H W + 1) are memory for it.
    """
    width = coc_px.shape[1]
    first, end = 0, 0
    for i in range(len(rims)):
        if pure[i] >= 0:
            y, x = rims[i] // width, rims[i] % width
            nearer_px = coc_px[y, x] - step_px
            end = _pass_on(seeds, squares, queue, queued, end, coc_px, y, x, pure[i], nearer_px, step_px)
    while first != end:
        place = queue[first]
        first = (first + 1) % queue.size
        queued[place] = False
        end = _pass_on(seeds, squares, queue, queued, end, coc_px, place // width, place % width, seeds[place] - 1, np.inf, step_px)


@njit(cache=True, nogil=True)
def _pass_on(
    seeds: np.ndarray,
    squares: np.ndarray,
    queue: np.ndarray,
    queued: np.ndarray,
    end: int,
    coc_px: np.ndarray,
    y: int,
    x: int,
    seed: int,
    nearer_px: float,
    step_px: float,
) -> int:
    """Let those around (y, x) with a smaller circle of confusion than `nearer_px` take its seed and queue, if that lies behind them,
    within sight, and nearer than the seed they have; the new end of the queue."""
    height, width = coc_px.shape
    sy, sx, seed_px = seed // width, seed % width, coc_px[seed // width, seed % width]
    for ny in range(max(0, y - 1), min(height, y + 2)):
        for nx in range(max(0, x - 1), min(width, x + 2)):
            behind_px, place = seed_px - coc_px[ny, nx], ny * width + nx
            if coc_px[ny, nx] >= nearer_px or behind_px <= step_px:
                continue
            square = (sy - ny) ** 2 + (sx - nx) ** 2
            if (squares[place] > 0 and square >= squares[place]) or square > (0.5 * behind_px + 3.5) ** 2:
                continue
            seeds[place], squares[place] = seed + 1, square
            if not queued[place]:
                queue[end], queued[place] = place, True
                end = (end + 1) % queue.size
    return end


@njit(cache=True, nogil=True, inline="always")
def _is_on(coc_px: np.ndarray, y: int, x: int, surface_coc_px: float, surface_px: float) -> bool:
    """Whether there is a pixel in this place, and it lies on the surface with this circle of confusion."""
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
    """Set filled (N, C) and its circles of confusion, first to end, to what is around each of the places on its seed's surface.

    The first pure pixels (of coc_px; others are NaN) along 8 paths, up to twice as far as the seed, weighted by one over the squared
    distance; on each path the mean of a quarter as many pixels as they are far. So behind a thin wire this interpolates
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
