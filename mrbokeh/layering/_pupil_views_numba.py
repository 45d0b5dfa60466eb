"""Compiled loops of mrbokeh.layering.pupil_views: surfaces seen from single points of the pupil, and lights behind what hides part of them.

What has the signed circle of confusion c and lies at x in the sharp picture is seen at x + u c / 2 through the point u of the unit pupil.
"""

from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit

_STEP_PX = np.float32(1.0)
"""Circles of confusion that differ by more belong to two surfaces (mrbokeh.layering.hidden_background)."""
_SLACK_PX = np.float32(0.3)
_FAR = np.float32(np.inf)
_BEFORE = np.int32(4096)
"""Whole pixels added to places before their fraction is cut off, so that it is cut downwards."""
_LEAST = np.float32(1e-6)
_LIT = np.float32(0.004)


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
                window.x_px[count] = places[i] - row * width - origin[1] + np.float32(0.5) + _BEFORE
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
def add_views(
    seen: np.ndarray, window: Window, pupil: np.ndarray, cells: np.ndarray, weights: np.ndarray, nearest: np.ndarray, which: np.ndarray
) -> None:
    """Add what each point of the pupil sees of a window's surfaces.

    seen: (rows, columns, 8) of a block: sums of r, g, b, weight, h and h^2, and the least and greatest h, half of the circle of confusion.
    pupil: (K, 3) x, y, and the coverage from which on a pixel is there. cells: (rows, columns) which row of weights (cells, K) holds.
    nearest, which: (rows + 2, columns + 2) to work in.
    """
    rows, columns, _ = seen.shape
    for k in range(len(pupil)):
        _view(nearest, which, window, pupil[k, 0], pupil[k, 1], pupil[k, 2])
        _close_cracks(nearest, which, window, True)
        _close_cracks(nearest, which, window, False)
        _add_view(seen, nearest, which, window.rgb, cells, weights[:, k])


@njit(cache=True, nogil=True, fastmath=True)
def _add_view(seen: np.ndarray, nearest: np.ndarray, which: np.ndarray, rgb: np.ndarray, cells: np.ndarray, weights: np.ndarray) -> None:
    """Add one view to the sums (see `add_views`). weights: (cells,) of this point."""
    rows, columns, _ = seen.shape
    for row in range(rows):
        found, numbers, halves_px, cell = seen[row], which[row + 1], nearest[row + 1], cells[row]
        for column in range(columns):
            i, weight = numbers[column + 1], weights[cell[column]]
            if i >= 0 and weight > 0:
                half_px = halves_px[column + 1]
                found[column, 0] += weight * rgb[i, 0]
                found[column, 1] += weight * rgb[i, 1]
                found[column, 2] += weight * rgb[i, 2]
                found[column, 3] += weight
                found[column, 4] += weight * half_px
                found[column, 5] += weight * half_px * half_px
                found[column, 6] = min(found[column, 6], half_px)
                found[column, 7] = max(found[column, 7], half_px)
                found[column, 8] += weight * (rgb[i, 0] * rgb[i, 0] + rgb[i, 1] * rgb[i, 1] + rgb[i, 2] * rgb[i, 2])


@njit(cache=True, nogil=True, fastmath=True)
def _view(nearest: np.ndarray, which: np.ndarray, window: Window, u: np.float32, v: np.float32, threshold: np.float32) -> None:
    """Find the nearest pixel of the window at each pixel of the block, seen from the point (u, v) of the pupil; -1 where nothing is."""
    rows, columns = nearest.shape
    for row in range(rows):
        for column in range(columns):
            nearest[row, column], which[row, column] = np.float32(np.inf), -1
    low_px, high_px = min(v * window.range_px[0], v * window.range_px[1]), max(v * window.range_px[0], v * window.range_px[1])
    last = window.starts.shape[1] - 1
    first = min(max(np.int64(np.floor(-high_px)) - 1 - window.top_px, 0), last)
    end = min(max(np.int64(np.ceil(rows - low_px)) + 1 - window.top_px, first), last)
    x_px, halves_px, alpha = window.x_px, window.half_px, window.alpha
    for surface in range(len(window.starts)):
        for line in range(first, end):
            y_px = np.float32(line + window.top_px) + np.float32(0.5) + _BEFORE
            for i in range(window.starts[surface, line], window.starts[surface, line + 1]):
                half_px = halves_px[i]
                row = np.uint32(np.int32(y_px + v * half_px) - _BEFORE)
                column = np.uint32(np.int32(x_px[i] + u * half_px) - _BEFORE)
                if row < np.uint32(rows) and column < np.uint32(columns) and half_px < nearest[row, column] and alpha[i] > threshold:
                    nearest[row, column], which[row, column] = half_px, i


@njit(cache=True, nogil=True)
def _close_cracks(nearest: np.ndarray, which: np.ndarray, window: Window, across: bool) -> None:
    """Fill pixels between two that are neighbours in the sharp picture, of one surface, nearer than what shows between them."""
    rows, columns = nearest.shape
    down, right = (0, 1) if across else (1, 0)
    for row in range(down, rows - down):
        before_px, here_px = nearest[row - down, : columns - 2 * right], nearest[row, right : columns - right]
        after_px = nearest[row + down, 2 * right :]
        cracks = 0
        for column in range(len(here_px)):
            cracks += max(before_px[column], after_px[column]) + _STEP_PX < here_px[column]
        if cracks == 0:
            continue
        for column in range(len(here_px)):
            if max(before_px[column], after_px[column]) + _STEP_PX < here_px[column]:
                before, after = which[row - down, column], which[row + down, column + 2 * right]
                if before != after and _are_neighbours(window, before, after, across):
                    here_px[column], which[row, column + right] = before_px[column], before


@njit(cache=True, nogil=True)
def _are_neighbours(window: Window, before: int, after: int, across: bool) -> bool:
    x, y = window.x_px[after] - window.x_px[before], window.y_px[after] - window.y_px[before]
    along, beside = (x, y) if across else (y, x)
    return along == 1.0 and abs(beside) <= 1.0 and abs(window.half_px[after] - window.half_px[before]) < _STEP_PX


@njit(cache=True, nogil=True)
def blend(
    colour: np.ndarray,
    seen: np.ndarray,
    lights: np.ndarray,
    tiles: np.ndarray,
    tile_px: int,
    top: int,
    left: int,
    points: int,
    one_surface_px: float,
    enough: float,
    noise: float,
) -> None:
    """Let the views of a block (see `add_views`) and the lights replace colour (H, W, 3 or more) in marked tiles.

    They count where circles of confusion differ by more than one_surface_px (all from twice that on) and by how much of the pupil sees
    another surface than the rest (all from a share `enough` on).
    """
    rows, columns, _ = seen.shape
    for row in range(rows):
        for column in range(columns):
            found, y, x = seen[row, column], top + row, left + column
            if found[3] <= 0 or not tiles[y // tile_px, x // tile_px]:
                continue
            apart_px, mean = 2.0 * (found[7] - found[6]), found[4] / found[3]
            share = 4.0 * (found[5] / found[3] - mean * mean) / max(apart_px * apart_px, _LEAST)
            counts = _smooth(apart_px / one_surface_px - 1.0) * _smooth(share / enough)
            changes, spread = np.float32(0.0), found[8] / found[3]
            for c in range(3):
                found[c] /= found[3]
                spread -= found[c] * found[c]
                found[c] += lights[y, x, c] - colour[y, x, c]
                changes += found[c] * found[c]
            counts *= changes / max(changes + noise * spread / points, _LEAST * _LEAST)
            for c in range(3):
                colour[y, x, c] += counts * found[c]


@njit(cache=True, nogil=True)
def _smooth(x: float) -> float:
    x = min(max(x, 0.0), 1.0)
    return x * x * (3.0 - 2.0 * x)


@njit(cache=True, nogil=True)
def add_cut_lights(
    out: np.ndarray,
    tiles: np.ndarray,
    tile_px: int,
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
    """Add lights of one size to marked tiles of a picture (H, W, 3), as far as what is nearer leaves the way free.

    places, rgb, coc_px: of the lights, in the frame with its margin; kernel: of that size, sum 1. occluder_px, occluder_alpha:
    (surfaces, rows, columns) circles of confusion and coverage in the frame with its margin, the nearest of them at nearest_px.
    """
    (height, width, _), around, half = out.shape, occluder_px.shape[2], len(kernel) // 2
    for i in range(len(places)):
        row, column, half_px = places[i] // around, places[i] % around, 0.5 * coc_px[i]
        for y in range(max(row - margin - half, 0), min(row - margin + half + 1, height)):
            for x in range(max(column - margin - half, 0), min(column - margin + half + 1, width)):
                share = kernel[y - row + margin + half, x - column + margin + half]
                if share <= 0.0 or not tiles[y // tile_px, x // tile_px]:
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
def darken(dark: np.ndarray, places: np.ndarray, values: np.ndarray, width: int) -> None:
    """Set dark (N, 3) to the median of the 5x5 pixels around each place, per colour, at most its own light. values: (rows * width, 4+)."""
    rows, around = len(values) // width, np.empty(25, np.float32)
    for i in range(len(places)):
        row, column = places[i] // width, places[i] % width
        for c in range(3):
            count = 0
            for y in range(max(row - 2, 0), min(row + 3, rows)):
                for x in range(max(column - 2, 0), min(column + 3, width)):
                    around[count] = values[y * width + x, c]
                    count += 1
            dark[i, c] = min(np.median(around[:count]), values[places[i], c])
