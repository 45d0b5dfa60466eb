"""Edges of the depth map for layering.hidden_background, compiled. Whether a pixel needs a closer look at all is asked of whole rows."""

import numpy as np

from mrbokeh.system.kernels import njit

_BESIDE = ((0, 1), (1, 0), (1, 1), (1, -1))


@njit(cache=True, nogil=True)
def snap(snapped: np.ndarray, coc_px: np.ndarray, lit: np.ndarray, step_px: float, top: int, bottom: int) -> None:
    """Rows top to bottom of circles of confusion in which no pixel floats in the air between two surfaces, as antialiased or
    resized depth makes them.

    A pixel between two even surfaces, each at most 2 pixels away on opposite sides, takes the nearer value of the two; a lit one
    does not, for lamps do hang in the air.
    """
    height, width = coc_px.shape
    lowest, highest, even_px = np.empty(width + 2, np.float32), np.empty(width + 2, np.float32), np.float32(0.5 * step_px)
    uneven = np.empty(width, np.bool_)
    for y in range(top, bottom):
        snapped[y] = coc_px[y]
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
    """Rows top to bottom of rim (H, W), bool: pixels with something more than `step_px` nearer beside them; they may hold some of
    its colour."""
    width = coc_px.shape[1]
    lowest, highest, least_px = np.empty(width + 2, np.float32), np.empty(width + 2, np.float32), np.float32(step_px)
    for y in range(top, bottom):
        _extremes_of_columns(lowest, highest, coc_px, y)
        here, found = coc_px[y], rim[y]
        for x in range(width):
            found[x] = here[x] - min(min(lowest[x], lowest[x + 1]), lowest[x + 2]) > least_px


@njit(cache=True, nogil=True)
def _extremes_of_columns(lowest: np.ndarray, highest: np.ndarray, coc_px: np.ndarray, y: int) -> None:
    """The least and the greatest of rows y - 1 to y + 1 (those there are), one pixel on the left; the ends are repeated."""
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
