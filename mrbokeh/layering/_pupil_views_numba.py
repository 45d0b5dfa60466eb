"""Compiled loops of mrbokeh.layering.pupil_views: surfaces seen from single points of the pupil, and lights behind what hides part of them.

What has the signed circle of confusion c and lies at x in the sharp picture is seen at x + u c / 2 through the point u of the unit pupil.
"""

from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit

_STEP_PX = np.float32(1.0)
"""Circles of confusion that differ by more belong to two surfaces (mrbokeh.layering.hidden_background)."""
_SLACK_PX = np.float32(0.3)
_HALF_A_STEP_PX = np.float32(0.5)
_FAR = np.float32(1e30)
BEFORE_PX = np.int32(4096)
"""Whole pixels added to places before their fraction is cut off, so that it is cut downwards."""
_LEAST = np.float32(1e-6)
_LIT = np.float32(0.004)
_MUCH = np.float32(0.1)


class Window(NamedTuple):
    """Pixels of all surfaces around a block, surface by surface, row by row.

    x_px, y_px: (N,) middles, from the corner of the block's margin of one pixel; half_px: (N,) half their circle of confusion;
    alpha: (N,); rgb: (N, 3) not premultiplied; starts: (surfaces, rows + 1) where rows begin; top_px: the first row, from the same corner.
    range_px: (2,) the least and the greatest of half_px.
    """

    x_px: np.ndarray
    y_px: np.ndarray
    half_px: np.ndarray
    alpha: np.ndarray
    rgb: np.ndarray
    starts: np.ndarray
    range_px: np.ndarray
    top_px: int


@njit(cache=True, nogil=True)
def mark_reach(tiles: np.ndarray, tile_px: int, width: int, margin: int, places: np.ndarray, reach_px: np.ndarray) -> None:
    """Mark the tiles that lie within reach (a square) of any of these places of a frame with a margin (row times width plus column)."""
    rows, columns = tiles.shape
    for i in range(len(places)):
        row, column, reach = places[i] // width - margin, places[i] % width - margin, int(reach_px[i])
        for y in range(max((row - reach) // tile_px, 0), min((row + reach) // tile_px + 1, rows)):
            for x in range(max((column - reach) // tile_px, 0), min((column + reach) // tile_px + 1, columns)):
                tiles[y, x] = True


@njit(cache=True, nogil=True)
def collect(
    window: Window,
    surface: int,
    first: int,
    origin: tuple[int, int],
    box: tuple[int, int, int, int],
    width: int,
    places: np.ndarray,
    values: np.ndarray,
    coc_px: np.ndarray,
) -> int:
    """Add the pixels of one surface that lie in a box (top, bottom, left, right) to a window from its pixel `first` on; return its end.

    origin: row and column of the corner of the block's margin.
    """
    top, bottom, left, right = box
    count = first
    for row in range(top, bottom):
        window.starts[surface, row - top] = count
        i = np.searchsorted(places, row * width + left)
        while i < len(places) and places[i] < row * width + right:
            alpha = values[i, 3]
            if alpha > _LEAST:
                window.x_px[count] = places[i] - row * width - origin[1] + np.float32(0.5) + BEFORE_PX
                window.y_px[count] = row - origin[0] + np.float32(0.5)
                window.half_px[count], window.alpha[count] = np.float32(0.5) * coc_px[i], alpha
                window.range_px[0] = min(window.range_px[0], window.half_px[count])
                window.range_px[1] = max(window.range_px[1], window.half_px[count])
                for c in range(3):
                    window.rgb[count, c] = values[i, c] / alpha
                count += 1
            i += 1
    window.starts[surface, bottom - top] = count
    return count


@njit(cache=True, nogil=True)
def correlate(
    sums: np.ndarray,
    window: Window,
    pupil: np.ndarray,
    cells: np.ndarray,
    weights: np.ndarray,
    surveyed: int,
    buffers: tuple[np.ndarray, ...],
) -> None:
    """Look through the points of the pupil at a window's surfaces, parted at each pixel halfway between the nearest and the farthest seen.

    sums: (rows, columns, 9) of a block: over points that see something far, of its r, g, b, of the same where something near hides it, of
    weights, of those where it is hidden, and of the squares of r, g and b. pupil: (K, 3) x, y, and the coverage from which on a pixel is
    there. cells: (rows, columns) which row of weights (cells, K) holds. surveyed: points that look for the nearest and the farthest.
    buffers: five of (rows + 2, columns + 2) to work in: half circles of confusion and numbers of the nearest and of the next surface, and
    where they part.
    """
    nearest, which, second, second_which, parts = buffers
    columns = sums.shape[1]
    farthest = np.full_like(nearest, -_FAR)
    parts[:] = _FAR
    for k in range(min(surveyed, len(pupil))):
        _view(nearest, which, second, second_which, window, pupil[k, 0], pupil[k, 1], pupil[k, 2])
        for row in range(len(parts)):
            for column in range(columns + 2):
                if which[row, column] >= 0:
                    parts[row, column] = min(parts[row, column], nearest[row, column])
                    last = second[row, column] if second_which[row, column] >= 0 else nearest[row, column]
                    farthest[row, column] = max(farthest[row, column], last)
    for row in range(len(parts)):
        for column in range(columns + 2):
            apart = farthest[row, column] - parts[row, column]
            parts[row, column] = np.float32(0.5) * (parts[row, column] + farthest[row, column]) if apart > _HALF_A_STEP_PX else -_FAR
    for k in range(len(pupil)):
        _view(nearest, which, second, second_which, window, pupil[k, 0], pupil[k, 1], pupil[k, 2])
        _add_view(sums, buffers, window.rgb, cells, weights[:, k])


@njit(cache=True, nogil=True, fastmath=True)
def _add_view(sums: np.ndarray, buffers: tuple[np.ndarray, ...], rgb: np.ndarray, cells: np.ndarray, weights: np.ndarray) -> None:
    """Add one view to the sums (see `correlate`). weights: (cells,) of this point."""
    nearest, which, second, second_which, parts = buffers
    rows, columns, _ = sums.shape
    for row in range(rows):
        found, cell = sums[row], cells[row]
        for column in range(columns):
            hidden = nearest[row + 1, column + 1] < parts[row + 1, column + 1]
            i = second_which[row + 1, column + 1] if hidden else which[row + 1, column + 1]
            weight = weights[cell[column]]
            if i < 0 or weight <= 0 or (hidden and second[row + 1, column + 1] < parts[row + 1, column + 1]):
                continue
            red, green, blue, over = (
                weight * rgb[i, 0],
                weight * rgb[i, 1],
                weight * rgb[i, 2],
                np.float32(1.0) if hidden else np.float32(0.0),
            )
            found[column, 0] += red
            found[column, 1] += green
            found[column, 2] += blue
            found[column, 3] += over * red
            found[column, 4] += over * green
            found[column, 5] += over * blue
            found[column, 6] += weight
            found[column, 7] += over * weight
            found[column, 8] += red * rgb[i, 0] + green * rgb[i, 1] + blue * rgb[i, 2]


@njit(cache=True, nogil=True, fastmath=True)
def _view(
    nearest: np.ndarray,
    which: np.ndarray,
    second: np.ndarray,
    second_which: np.ndarray,
    window: Window,
    u: np.float32,
    v: np.float32,
    threshold: np.float32,
) -> None:
    """Find the nearest pixel of the window at each pixel of the block seen from the point (u, v) of the pupil, and that of the next surface.

    -1 where there is none.
    """
    rows, columns = nearest.shape
    for row in range(rows):
        for column in range(columns):
            nearest[row, column], which[row, column] = _FAR, -1
            second[row, column], second_which[row, column] = _FAR, -1
    low_px, high_px = min(v * window.range_px[0], v * window.range_px[1]), max(v * window.range_px[0], v * window.range_px[1])
    last = window.starts.shape[1] - 1
    first = min(max(np.int64(np.floor(-high_px)) - 1 - window.top_px, 0), last)
    end = min(max(np.int64(np.ceil(rows - low_px)) + 1 - window.top_px, first), last)
    x_px, halves_px, alpha = window.x_px, window.half_px, window.alpha
    for surface in range(len(window.starts)):
        for line in range(first, end):
            y_px = np.float32(line + window.top_px) + np.float32(0.5) + BEFORE_PX
            for i in range(window.starts[surface, line], window.starts[surface, line + 1]):
                half_px = halves_px[i]
                row = np.uint32(np.int32(y_px + v * half_px) - BEFORE_PX)
                column = np.uint32(np.int32(x_px[i] + u * half_px) - BEFORE_PX)
                if row < np.uint32(rows) and column < np.uint32(columns) and half_px < second[row, column] and alpha[i] > threshold:
                    there_px = nearest[row, column]
                    if half_px < there_px:
                        if there_px - half_px > _HALF_A_STEP_PX:
                            second[row, column], second_which[row, column] = there_px, which[row, column]
                        nearest[row, column], which[row, column] = half_px, i
                    elif half_px - there_px > _HALF_A_STEP_PX:
                        second[row, column], second_which[row, column] = half_px, i


@njit(cache=True, nogil=True)
def take_back(
    colour: np.ndarray, sums: np.ndarray, tiles: np.ndarray, tile_px: int, top: int, left: int, points: int, noise: float
) -> None:
    """Subtract from colour (H, W, 3 or more) of a block, in marked tiles, how far light and what hides it go together (see `correlate`).

    It counts by its square over that and the square of what chance makes of so few points.
    """
    rows, columns, _ = sums.shape
    for row in range(rows):
        for column in range(columns):
            found, y, x = sums[row, column], top + row, left + column
            if found[7] <= 0 or found[7] >= found[6] or not tiles[y // tile_px, x // tile_px]:
                continue
            hidden, square, spread = found[7] / found[6], np.float32(0.0), found[8] / found[6]
            for c in range(3):
                mean = found[c] / found[6]
                found[c] = found[3 + c] / found[6] - hidden * mean
                square, spread = square + found[c] * found[c], spread - mean * mean
            chance = noise * hidden * (np.float32(1.0) - hidden) * max(spread, np.float32(0.0)) / points
            counts = square / max(square + chance, _LEAST * _LEAST)
            for c in range(3):
                colour[y, x, c] = max(colour[y, x, c] - counts * found[c], np.float32(0.0))


@njit(cache=True, nogil=True)
def add_cut_lights(
    out: np.ndarray,
    margin: int,
    places: np.ndarray,
    rgb: np.ndarray,
    coc_px: np.ndarray,
    kernel: np.ndarray,
    unit_radius: float,
    occluder_px: np.ndarray,
    occluder_alpha: np.ndarray,
    nearest_px: float,
) -> None:
    """Add lights of one size to a picture (H, W, 3 or more), as far as what is nearer leaves the way free.

    places, rgb, coc_px: of the lights, in the frame with its margin; kernel: of that size, sum 1. occluder_px, occluder_alpha:
    (surfaces, rows, columns) circles of confusion and coverage in the frame with its margin, the nearest of them at nearest_px.
    """
    height, width, around, half = out.shape[0], out.shape[1], occluder_px.shape[2], len(kernel) // 2
    for i in range(len(places)):
        row, column, half_px = places[i] // around, places[i] % around, 0.5 * coc_px[i]
        for y in range(max(row - margin - half, 0), min(row - margin + half + 1, height)):
            for x in range(max(column - margin - half, 0), min(column - margin + half + 1, width)):
                share = kernel[y - row + margin + half, x - column + margin + half]
                if share <= 0.0:
                    continue
                free = np.float32(0.0)
                for ray in range(4):
                    right, down = 0.25 if ray % 2 else -0.25, 0.25 if ray // 2 else -0.25
                    u, v = 0.0, 0.0
                    if abs(half_px) > 0.5:
                        u, v = (x + right + margin - column) / half_px, (y + down + margin - row) / half_px
                        beyond = np.sqrt(u * u + v * v) / unit_radius
                        if beyond > 1.0:
                            u, v = u / beyond, v / beyond
                    x_px, y_px = column + 0.5 + u * half_px, row + 0.5 + v * half_px
                    free += _free(occluder_px, occluder_alpha, x_px, y_px, u, v, coc_px[i], nearest_px)
                free *= np.float32(0.25 * share)
                for c in range(3):
                    out[y, x, c] += free * rgb[i, c]


@njit(cache=True, nogil=True, fastmath=True)
def _free(
    coc_px: np.ndarray, alpha: np.ndarray, x_px: float, y_px: float, u: float, v: float, light_px: float, nearest_px: float
) -> np.float32:
    """Return how much of a ray to (x_px, y_px) through (u, v) gets past all that is nearer than a light, walked from the nearest on."""
    surfaces, rows, columns = coc_px.shape
    steps = int(np.ceil(max(abs(u), abs(v)) * (light_px - nearest_px) * 0.5)) + 1
    step_px, free, last_px = (light_px - nearest_px) / steps, np.float32(1.0), _FAR
    for step in range(steps):
        first_px = nearest_px + step * step_px
        middle_px = 0.5 * (first_px + 0.5 * step_px)
        row, column = int(y_px - v * middle_px), int(x_px - u * middle_px)
        row, column = min(max(row, 0), rows - 1), min(max(column, 0), columns - 1)
        for surface in range(surfaces):
            met_px, covers = coc_px[surface, row, column], alpha[surface, row, column]
            if (
                covers > 0.0
                and first_px - _SLACK_PX <= met_px <= first_px + step_px + _SLACK_PX
                and met_px < light_px - _STEP_PX
                and abs(met_px - last_px) > _STEP_PX
            ):
                free, last_px = free * (np.float32(1.0) - covers), met_px
        if free < _LIT:
            return np.float32(0.0)
    return free


@njit(cache=True, nogil=True)
def darken(dark: np.ndarray, places: np.ndarray, values: np.ndarray, lit: np.ndarray, width: int, ratio: float) -> None:
    """Set dark (N, 3) to the light that each place would have if it were no light: its coverage times the median around, at most its own.

    values: (rows * width, 4 or more) premultiplied, lit: (rows * width,) all lights; medians are of those of the 5x5 pixels that cover much
    and are no lights. A place that is not `ratio` times as bright keeps its own light.
    """
    rows, around = len(values) // width, np.empty(25, np.float32)
    for i in range(len(places)):
        row, column, own = places[i] // width, places[i] % width, values[places[i]]
        for c in range(3):
            count = 0
            for y in range(max(row - 2, 0), min(row + 3, rows)):
                for x in range(max(column - 2, 0), min(column + 3, width)):
                    alpha = values[y * width + x, 3]
                    if alpha > _MUCH and not lit[y * width + x]:
                        around[count] = values[y * width + x, c] / alpha
                        count += 1
            dark[i, c] = min(own[3] * np.median(around[:count]), own[c]) if count else 0.0
        if max(own[0], own[1], own[2]) <= ratio * max(dark[i, 0], dark[i, 1], dark[i, 2]):
            dark[i] = own[:3]
