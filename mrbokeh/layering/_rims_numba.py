"""How mrbokeh.layering.hidden_background parts the pixels of a rim, compiled."""

import numpy as np

from mrbokeh.system.kernels import njit

_LARGEST_SHARE = 0.6


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

    rims: (R,) places. front: (R, C), the pixels before; behind: (N, C), at of_behind (R,) what was filled in.
    Of the nearer neighbours the one counts that differs most from what is filled in: it is the least mixed itself. Its share
    explains the pixel best as a mixture of the two, is smaller the worse the mixture explains it, and at most 0.6, as the pixel's
    own depth is that behind. One brighter than the neighbour is no mixture of it (a lamp behind a wire) and stays whole.
    Front and rest together are the pixel: no light is lost.
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
        share = min(_LARGEST_SHARE, explained * along / most)
        front_coc_px[i] = coc_px[fy, fx]
        for c in range(channels):
            rest = (values[y, x, c] - share * values[fy, fx, c]) / (1.0 - share)
            filled[c] = max(0.0, rest) if c < 3 else rest
            front[i, c] = values[y, x, c] - (1.0 - share) * filled[c]
        front[i, 3], filled[3] = share, 1.0


@njit(cache=True, nogil=True)
def _most_different(values: np.ndarray, coc_px: np.ndarray, y: int, x: int, filled: np.ndarray, step_px: float) -> tuple[int, int, float]:
    """Of the nearer neighbours the one whose colour is farthest from what is filled in, and the square of that distance; else -1."""
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
    """Whether the brightest of the 5x5 pixels around, the lamp whose light a pixel holds, is nearer than the pixel."""
    height, width, _ = values.shape
    brightest, nearer = -1.0, False
    for ny in range(max(0, y - 2), min(height, y + 3)):
        for nx in range(max(0, x - 2), min(width, x + 3)):
            brightness = values[ny, nx, 0] + values[ny, nx, 1] + values[ny, nx, 2]
            if brightness > brightest:
                brightest, nearer = brightness, coc_px[ny, nx] < coc_px[y, x] - step_px
    return nearer
