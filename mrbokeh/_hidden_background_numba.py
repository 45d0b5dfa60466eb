"""The searches of mrbokeh.hidden_background, compiled."""

import math

import numpy as np
from numba import njit

_DIRECTIONS = 8
_LARGEST_SHARE = 0.6


@njit(cache=True, nogil=True)
def snapped(coc_px: np.ndarray, lit: np.ndarray, step_px: float) -> np.ndarray:
    """Circles of confusion in which no pixel floats in the air between two surfaces, as antialiased or resized depth makes them.

    A pixel between two even surfaces, each at most 2 pixels away on opposite sides, takes the nearer value of the two; a lit one
    does not, for lamps do hang in the air.
    """
    height, width = coc_px.shape
    result = coc_px.copy()
    even_px = 0.5 * step_px
    for y in range(3, height - 3):
        for x in range(3, width - 3):
            here = coc_px[y, x]
            if lit[y, x]:
                continue
            for dy, dx in ((0, 1), (1, 0), (1, 1), (1, -1)):
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
                            result[y, x] = a if abs(here - a) < abs(b - here) else b
    return result


@njit(cache=True, nogil=True)
def rims(coc_px: np.ndarray, step_px: float) -> np.ndarray:
    """(H, W) bool: pixels with something more than `step_px` nearer beside them; they may hold some of its colour."""
    height, width = coc_px.shape
    rim = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            here = coc_px[y, x]
            for ny in range(y, min(height, y + 2)):
                for nx in range(x if ny == y else max(0, x - 1), min(width, x + 2)):
                    difference = here - coc_px[ny, nx]
                    if difference > step_px:
                        rim[y, x] = True
                    elif difference < -step_px:
                        rim[ny, nx] = True
    return rim


@njit(cache=True, nogil=True)
def far_over_median(brightness: np.ndarray, candidates: np.ndarray, ratio: float) -> np.ndarray:
    """Of the candidates, (H, W) bool, those more than `ratio` times as bright as most (13) of the 5x5 pixels around them."""
    height, width = brightness.shape
    found = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            if not candidates[y, x]:
                continue
            darker = 0
            for ny in range(y - 2, y + 3):
                for nx in range(x - 2, x + 3):
                    darker += ratio * brightness[min(max(ny, 0), height - 1), min(max(nx, 0), width - 1)] < brightness[y, x]
            found[y, x] = darker >= 13
    return found


@njit(cache=True, nogil=True)
def pure_neighbours(coc_px: np.ndarray, pure: np.ndarray, step_px: float, radius_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the nearest pure pixel of the same surface, itself where it is pure; -1 where none is within `radius_px`."""
    height, width = coc_px.shape
    pure_y, pure_x = np.full((height, width), -1, np.int32), np.full((height, width), -1, np.int32)
    for y in range(height):
        for x in range(width):
            if pure[y, x]:
                pure_y[y, x], pure_x[y, x] = y, x
                continue
            least = (radius_px + 1) ** 2
            for ny in range(max(0, y - radius_px), min(height, y + radius_px + 1)):
                for nx in range(max(0, x - radius_px), min(width, x + radius_px + 1)):
                    distance = (ny - y) ** 2 + (nx - x) ** 2
                    if distance < least and pure[ny, nx] and abs(coc_px[ny, nx] - coc_px[y, x]) <= step_px:
                        least = distance
                        pure_y[y, x], pure_x[y, x] = ny, nx
    return pure_y, pure_x


@njit(cache=True, nogil=True)
def _takes(seed_y: np.ndarray, seed_x: np.ndarray, coc_px: np.ndarray, y: int, x: int, sy: int, sx: int, step_px: float) -> bool:
    """Let pixel (y, x) take (sy, sx) for its seed if that lies behind it, within sight, and nearer than the seed it has."""
    behind_px = coc_px[sy, sx] - coc_px[y, x]
    distance = (sy - y) ** 2 + (sx - x) ** 2
    if behind_px <= step_px or distance > (0.5 * behind_px + 3.5) ** 2:
        return False
    if seed_y[y, x] >= 0 and distance >= (seed_y[y, x] - y) ** 2 + (seed_x[y, x] - x) ** 2:
        return False
    seed_y[y, x], seed_x[y, x] = sy, sx
    return True


@njit(cache=True, nogil=True)
def nearest_behind(
    coc_px: np.ndarray, rim: np.ndarray, pure_y: np.ndarray, pure_x: np.ndarray, step_px: float
) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the nearest pure pixel that lies more than `step_px` behind; -1 where the lens sees none.

    The lens sees past an edge by half the difference of the two circles of confusion (and a rim's width more is searched).
    A brush fire from the edges inwards; the condition differs from pixel to pixel, and a seed travels only through pixels
    that it lies behind, so that a nearer one can be missed by a pixel or two where several depths meet.
    """
    height, width = coc_px.shape
    seed_y, seed_x = np.full((height, width), -1, np.int32), np.full((height, width), -1, np.int32)
    queued = np.zeros(height * width, np.bool_)
    queue = np.empty(height * width + 1, np.int64)
    first, end = 0, 0
    for y in range(height):
        for x in range(width):
            if not rim[y, x] or pure_y[y, x] < 0:
                continue
            for ny in range(max(0, y - 1), min(height, y + 2)):
                for nx in range(max(0, x - 1), min(width, x + 2)):
                    nearer = coc_px[ny, nx] < coc_px[y, x] - step_px
                    if (
                        nearer
                        and _takes(seed_y, seed_x, coc_px, ny, nx, pure_y[y, x], pure_x[y, x], step_px)
                        and not queued[ny * width + nx]
                    ):
                        queue[end], queued[ny * width + nx] = ny * width + nx, True
                        end += 1
    while first != end:
        y, x = queue[first] // width, queue[first] % width
        first = (first + 1) % queue.size
        queued[y * width + x] = False
        for ny in range(max(0, y - 1), min(height, y + 2)):
            for nx in range(max(0, x - 1), min(width, x + 2)):
                taken = _takes(seed_y, seed_x, coc_px, ny, nx, seed_y[y, x], seed_x[y, x], step_px)
                if taken and not queued[ny * width + nx]:
                    queue[end], queued[ny * width + nx] = ny * width + nx, True
                    end = (end + 1) % queue.size
    return seed_y, seed_x


@njit(cache=True, nogil=True)
def interpolate(
    filled: np.ndarray,
    filled_coc_px: np.ndarray,
    values: np.ndarray,
    coc_px: np.ndarray,
    pure: np.ndarray,
    seed_y: np.ndarray,
    seed_x: np.ndarray,
    surface_px: float,
    top: int,
    bottom: int,
) -> None:
    """Where rows top to bottom have a seed, overwrite filled (H, W, C) and its circle of confusion by what is around on the seed's surface.

    The first pure pixels in 8 directions, up to twice as far as the seed, weighted by one over the squared distance; in each
    direction the mean of a quarter as many pixels as they are far. So behind a thin wire this interpolates between both
    sides, and behind a broad object it continues what is beside it, ever smoother, as a guess should be.
    """
    height, width, channels = values.shape
    for y in range(top, bottom):
        for x in range(width):
            if seed_y[y, x] < 0:
                continue
            sy, sx = seed_y[y, x], seed_x[y, x]
            nearest_px = math.sqrt((sy - y) ** 2 + (sx - x) ** 2)
            total = 1.0 / max(nearest_px, 0.5) ** 2
            coc_sum = total * coc_px[sy, sx]
            for c in range(channels):
                filled[y, x, c] = total * values[sy, sx, c]
            for direction in range(_DIRECTIONS):
                angle_rad = 2.0 * math.pi * direction / _DIRECTIONS
                step_x, step_y = math.cos(angle_rad), math.sin(angle_rad)
                first = 0
                for distance in range(1, int(4.0 * nearest_px) + 6):
                    ny, nx = int(round(y + distance * step_y)), int(round(x + distance * step_x))
                    if not (0 <= ny < height and 0 <= nx < width) or (first == 0 and distance > 2.0 * nearest_px + 3.0):
                        break
                    if pure[ny, nx] and abs(coc_px[ny, nx] - coc_px[sy, sx]) <= surface_px:
                        first = distance if first == 0 else first
                        weight = 1.0 / (first**2 * max(1, first // 4))
                        total += weight
                        coc_sum += weight * coc_px[ny, nx]
                        for c in range(channels):
                            filled[y, x, c] += weight * values[ny, nx, c]
                        if distance - first + 1 >= first // 4:
                            break
                    elif first > 0:
                        break
            filled_coc_px[y, x] = coc_sum / total
            for c in range(channels):
                filled[y, x, c] /= total


@njit(cache=True, nogil=True)
def _lamp_in_front(values: np.ndarray, coc_px: np.ndarray, y: int, x: int, step_px: float) -> bool:
    """Whether the brightest of the 5x5 pixels around, the lamp whose light a pixel holds, is nearer than the pixel."""
    height, width, _ = values.shape
    brightest, nearer = -1.0, False
    for ny in range(max(0, y - 2), min(height, y + 3)):
        for nx in range(max(0, x - 2), min(width, x + 3)):
            brightness = values[ny, nx, 0] + values[ny, nx, 1] + values[ny, nx, 2]
            if brightness > brightest:
                brightest, nearer = brightness, coc_px[ny, nx] < coc_px[y, x] - step_px
    return nearer


@njit(cache=True, nogil=True)
def unmix_rims(
    front: np.ndarray,
    front_coc_px: np.ndarray,
    values: np.ndarray,
    coc_px: np.ndarray,
    behind: np.ndarray,
    seeded: np.ndarray,
    lit: np.ndarray,
    step_px: float,
) -> None:
    """Split the seeded rim pixels into what the nearer neighbour gave, in front, and the rest, which replaces what was filled in behind.

    Of the nearer neighbours the one counts that differs most from what is filled in: it is the least mixed itself. Its share
    explains the pixel best as a mixture of the two, is smaller the worse the mixture explains it, and at most 0.6, as the pixel's
    own depth is that behind. One brighter than the neighbour is no mixture of it (a lamp behind a wire) and stays whole.
    Front and rest together are the pixel: no light is lost.
    """
    height, width, channels = values.shape
    for y in range(height):
        for x in range(width):
            if not seeded[y, x]:
                continue
            fy, fx, most = -1, -1, 0.0
            for ny in range(max(0, y - 1), min(height, y + 2)):
                for nx in range(max(0, x - 1), min(width, x + 2)):
                    if coc_px[ny, nx] < coc_px[y, x] - step_px:
                        difference = 0.0
                        for c in range(3):
                            difference += (values[ny, nx, c] - behind[y, x, c]) ** 2
                        if difference > most:
                            fy, fx, most = ny, nx, difference
            if fy < 0:
                continue
            if lit[y, x] and not _lamp_in_front(values, coc_px, y, x, step_px):
                continue
            along, off = 0.0, 0.0
            for c in range(3):
                along += (values[y, x, c] - behind[y, x, c]) * (values[fy, fx, c] - behind[y, x, c])
                off += (values[y, x, c] - behind[y, x, c]) ** 2
            if along > most:
                continue
            explained = along * along / (most * off) if off > 0.0 and along > 0.0 else 0.0
            share = min(_LARGEST_SHARE, explained * along / most)
            front_coc_px[y, x] = coc_px[fy, fx]
            for c in range(channels):
                rest = (values[y, x, c] - share * values[fy, fx, c]) / (1.0 - share)
                behind[y, x, c] = max(0.0, rest) if c < 3 else rest
                front[y, x, c] = values[y, x, c] - (1.0 - share) * behind[y, x, c]
            front[y, x, 3], behind[y, x, 3] = share, 1.0
