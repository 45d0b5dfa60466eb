"""The sweeps of mrbokeh.hidden_background, compiled: for every pixel the nearest one that lies behind it."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True)
def _offer(seed_y: np.ndarray, seed_x: np.ndarray, coc_px: np.ndarray, y: int, x: int, sy: int, sx: int, step_px: float) -> None:
    """Let pixel (y, x) take (sy, sx) for its seed if that lies behind it, within sight, and nearer than the seed it has."""
    if sy < 0 or coc_px[sy, sx] <= coc_px[y, x] + step_px:
        return
    distance = (sy - y) ** 2 + (sx - x) ** 2
    sight_px = 0.5 * (coc_px[sy, sx] - coc_px[y, x]) + 3.5
    if distance > sight_px * sight_px:
        return
    if seed_y[y, x] < 0 or distance < (seed_y[y, x] - y) ** 2 + (seed_x[y, x] - x) ** 2:
        seed_y[y, x], seed_x[y, x] = sy, sx


@njit(cache=True, nogil=True)
def pure_neighbours(coc_px: np.ndarray, step_px: float, radius_px: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the nearest pixel of the same surface that has nothing nearer beside it: itself, or, at a rim, one farther in.

    Pixels at a rim hold some of the colour of what is in front. -1 where there is no pure one within `radius_px`.
    """
    height, width = coc_px.shape
    rim = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            for ny in range(max(0, y - 1), min(height, y + 2)):
                for nx in range(max(0, x - 1), min(width, x + 2)):
                    rim[y, x] |= coc_px[ny, nx] < coc_px[y, x] - step_px
    pure_y, pure_x = np.full((height, width), -1, np.int32), np.full((height, width), -1, np.int32)
    for y in range(height):
        for x in range(width):
            if not rim[y, x]:
                pure_y[y, x], pure_x[y, x] = y, x
                continue
            least = (radius_px + 1) ** 2
            for ny in range(max(0, y - radius_px), min(height, y + radius_px + 1)):
                for nx in range(max(0, x - radius_px), min(width, x + radius_px + 1)):
                    distance = (ny - y) ** 2 + (nx - x) ** 2
                    if distance < least and not rim[ny, nx] and abs(coc_px[ny, nx] - coc_px[y, x]) <= step_px:
                        least = distance
                        pure_y[y, x], pure_x[y, x] = ny, nx
    return pure_y, pure_x


@njit(cache=True, nogil=True)
def nearest_behind(coc_px: np.ndarray, pure_y: np.ndarray, pure_x: np.ndarray, step_px: float, sweeps: int) -> tuple[np.ndarray, np.ndarray]:
    """Row and column of the nearest pixel whose circle of confusion lies more than `step_px` behind; -1 where the lens sees none.

    The lens sees past an edge by half the difference of the two circles of confusion. Vector distance propagation
    (Danielsson 1980) with a condition that differs from pixel to pixel: a seed travels through pixels that it lies
    behind as well, so it can miss a nearer seed by a pixel or two where several depths meet.
    """
    height, width = coc_px.shape
    seed_y, seed_x = np.full((height, width), -1, np.int32), np.full((height, width), -1, np.int32)
    for sweep in range(2 * sweeps):
        down = sweep % 2 == 0
        dy = -1 if down else 1
        for row in range(height):
            y = row if down else height - 1 - row
            for i in range(width):
                x = i if down else width - 1 - i
                for dx in range(-1, 2):
                    ny, nx = y + dy, x + dx
                    if 0 <= ny < height and 0 <= nx < width:
                        _offer(seed_y, seed_x, coc_px, y, x, pure_y[ny, nx], pure_x[ny, nx], step_px)
                        _offer(seed_y, seed_x, coc_px, y, x, seed_y[ny, nx], seed_x[ny, nx], step_px)
                nx = x - 1 if down else x + 1
                if 0 <= nx < width:
                    _offer(seed_y, seed_x, coc_px, y, x, pure_y[y, nx], pure_x[y, nx], step_px)
                    _offer(seed_y, seed_x, coc_px, y, x, seed_y[y, nx], seed_x[y, nx], step_px)
            for i in range(width):
                x = width - 1 - i if down else i
                nx = x + 1 if down else x - 1
                if 0 <= nx < width:
                    _offer(seed_y, seed_x, coc_px, y, x, pure_y[y, nx], pure_x[y, nx], step_px)
                    _offer(seed_y, seed_x, coc_px, y, x, seed_y[y, nx], seed_x[y, nx], step_px)
    return seed_y, seed_x
