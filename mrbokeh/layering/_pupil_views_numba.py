"""Compiled loops of mrbokeh.layering.pupil_views: surfaces seen from single points of the pupil, and lights behind what hides part of them.

What has the signed circle of confusion c and lies at x in the sharp picture is seen at x + u c / 2 through the point u of the unit pupil.
"""

from typing import NamedTuple

import numpy as np

from mrbokeh.system.compiled import njit

_STEP_PX = np.float32(1.0)
"""Circles of confusion that differ by more belong to two surfaces (mrbokeh.layering.hidden_background)."""
_SLACK_PX = np.float32(0.3)
_FAR = np.float32(1e30)
BEFORE_PX = np.int32(4096)
"""Whole pixels added to places before their fraction is cut off, so that it is cut downwards."""
_LEAST = np.float32(1e-6)
_LIT = np.float32(0.004)
_MUCH = np.float32(0.1)
_APART = np.float32(0.7548776662466927)
"""Between the thresholds of groups, so that soft coverage of one has nothing to do with that of another (one over the plastic number)."""


class Window(NamedTuple):
    """Pixels of all surfaces around a block, surface by surface, row by row.

    x_px, y_px: (N,) middles, from the block's corner (x by BEFORE_PX more); half_px: (N,) half their circle of confusion;
    alpha: (N,); rgb: (N, 3) not premultiplied; starts: (surfaces, rows + 1) where rows begin; top_px: the first row, from there.
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


class Occluders(NamedTuple):
    """Surfaces in the frame with its margin: (surfaces, rows, columns) circles of confusion and coverage, and the least of the former."""

    coc_px: np.ndarray
    alpha: np.ndarray
    nearest_px: float


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

    origin: row and column of the block's corner.
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
    groups: np.ndarray,
    pupil: np.ndarray,
    cells: np.ndarray,
    weights: np.ndarray,
    nearest: np.ndarray,
    which: np.ndarray,
) -> None:
    """Look through the points of the pupil at groups of a window's surfaces, and at what each group hides.

    sums: (rows, columns, groups - 1, 9) of a block: for each group but the last, over the points that see something behind it: weights, of
    those in whose way it lies, r, g, b of what is behind, the same where it is hidden, and the squares of r, g and b. groups: (surfaces,)
    group of each, front first. pupil: (K, 3) x, y, and the coverage from which on a pixel is there. cells: (rows, columns) which row of
    weights (cells, K) holds. nearest, which: (groups, rows, columns) to work in.
    """
    for k in range(len(pupil)):
        _view(nearest, which, window, groups, pupil[k, 0], pupil[k, 1], pupil[k, 2])
        for group in range(len(which) - 1):
            _close_cracks(which[group], window)
        _add_view(sums, which, window.rgb, cells, weights[:, k])


@njit(cache=True, nogil=True, fastmath=True)
def _add_view(sums: np.ndarray, which: np.ndarray, rgb: np.ndarray, cells: np.ndarray, weights: np.ndarray) -> None:
    """Add one view to the sums (see `correlate`). weights: (cells,) of this point."""
    rows, columns, steps, _ = sums.shape
    for row in range(rows):
        for column in range(columns):
            weight, behind = weights[cells[row, column]], which[steps, row, column]
            if weight <= 0:
                continue
            for group in range(steps - 1, -1, -1):
                before = which[group, row, column]
                if behind >= 0:
                    found, over = sums[row, column, group], np.float32(1.0) if before >= 0 else np.float32(0.0)
                    red, green, blue = weight * rgb[behind, 0], weight * rgb[behind, 1], weight * rgb[behind, 2]
                    found[0] += weight
                    found[1] += over * weight
                    found[2] += red
                    found[3] += green
                    found[4] += blue
                    found[5] += over * red
                    found[6] += over * green
                    found[7] += over * blue
                    found[8] += red * rgb[behind, 0] + green * rgb[behind, 1] + blue * rgb[behind, 2]
                if before >= 0:
                    behind = before


@njit(cache=True, nogil=True, fastmath=True)
def _view(
    nearest: np.ndarray, which: np.ndarray, window: Window, groups: np.ndarray, u: np.float32, v: np.float32, threshold: np.float32
) -> None:
    """Find the nearest pixel of each group between every pixel of a block and the point (u, v) of the pupil; -1 where there is none."""
    _, rows, columns = nearest.shape
    nearest[:], which[:] = _FAR, -1
    low_px, high_px = min(v * window.range_px[0], v * window.range_px[1]), max(v * window.range_px[0], v * window.range_px[1])
    last = window.starts.shape[1] - 1
    first = min(max(np.int64(np.floor(-high_px)) - 1 - window.top_px, 0), last)
    end = min(max(np.int64(np.ceil(rows - low_px)) + 1 - window.top_px, first), last)
    x_px, halves_px, alpha = window.x_px, window.half_px, window.alpha
    for surface in range(len(window.starts)):
        near, numbers = nearest[groups[surface]], which[groups[surface]]
        least = (threshold + np.float32(groups[surface]) * _APART) % np.float32(1.0)
        for line in range(first, end):
            y_px = np.float32(line + window.top_px) + np.float32(0.5) + BEFORE_PX
            for i in range(window.starts[surface, line], window.starts[surface, line + 1]):
                half_px = halves_px[i]
                row = np.uint32(np.int32(y_px + v * half_px) - BEFORE_PX)
                column = np.uint32(np.int32(x_px[i] + u * half_px) - BEFORE_PX)
                if row < np.uint32(rows) and column < np.uint32(columns) and half_px < near[row, column] and alpha[i] > least:
                    near[row, column], numbers[row, column] = half_px, i


@njit(cache=True, nogil=True)
def _close_cracks(numbers: np.ndarray, window: Window) -> None:
    """Fill places between two pixels of a view that lie side by side in their surface: a slope is drawn apart, but has no holes."""
    rows, columns = numbers.shape
    for down, right in ((0, 1), (1, 0)):
        for row in range(down, rows - down):
            for column in range(right, columns - right):
                if numbers[row, column] < 0:
                    before, after = numbers[row - down, column - right], numbers[row + down, column + right]
                    if before >= 0 and after >= 0 and _are_neighbours(window, before, after):
                        numbers[row, column] = before


@njit(cache=True, nogil=True)
def _are_neighbours(window: Window, i: int, j: int) -> bool:
    """Return whether two pixels are one surface and at most one lies between them: slopes that shift rows draw such gaps."""
    apart_px = max(abs(window.x_px[i] - window.x_px[j]), abs(window.y_px[i] - window.y_px[j]))
    return apart_px < 2.5 and 2.0 * abs(window.half_px[i] - window.half_px[j]) < _STEP_PX


@njit(cache=True, nogil=True)
def take_back(colour: np.ndarray, sums: np.ndarray, tiles: np.ndarray, tile_px: int, top: int, left: int, noise: float) -> None:
    """Subtract from colour (H, W, 3 or more), in marked tiles of a block, how far groups and what they hide go together (`correlate`).

    It counts by its square over that and the square of what chance makes of so few points.
    """
    rows, columns, steps, _ = sums.shape
    change = np.empty(3, np.float32)
    for row in range(rows):
        for column in range(columns):
            y, x, free = top + row, left + column, np.float32(1.0)
            if not tiles[y // tile_px, x // tile_px]:
                continue
            for group in range(steps):
                found = sums[row, column, group]
                if found[1] <= 0 or found[1] >= found[0]:
                    free = free if found[1] <= 0 else np.float32(0.0)
                    continue
                hidden, square, spread = found[1] / found[0], np.float32(0.0), found[8] / found[0]
                for c in range(3):
                    mean = found[2 + c] / found[0]
                    change[c] = found[5 + c] / found[0] - hidden * mean
                    square, spread = square + change[c] * change[c], spread - mean * mean
                chance = noise * hidden * (np.float32(1.0) - hidden) * max(spread, np.float32(0.0)) / found[0]
                counts = free * square / max(square + chance, _LEAST * _LEAST)
                for c in range(3):
                    colour[y, x, c] = max(colour[y, x, c] - counts * change[c], np.float32(0.0))
                free *= np.float32(1.0) - hidden


@njit(cache=True, nogil=True)
def add_cut_lights(
    out: np.ndarray,
    lines: tuple[int, int],
    margin: int,
    places: np.ndarray,
    rgb: np.ndarray,
    coc_px: np.ndarray,
    kernel: np.ndarray,
    unit_radius: float,
    before: Occluders,
) -> None:
    """Add lights of one size to rows (first, end) of a picture (H, W, 3 or more), as far as what is nearer leaves the way free.

    places, rgb, coc_px: of the lights, in the frame with its margin; kernel: of that size, sum 1. before: all that may lie in the way.
    """
    width, around, half = out.shape[1], before.coc_px.shape[2], len(kernel) // 2
    for i in range(len(places)):
        row, column, half_px = places[i] // around, places[i] % around, 0.5 * coc_px[i]
        for y in range(max(row - margin - half, lines[0]), min(row - margin + half + 1, lines[1])):
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
                    free += _free(before, x_px, y_px, u, v, coc_px[i])
                free *= np.float32(0.25 * share)
                for c in range(3):
                    out[y, x, c] += free * rgb[i, c]


@njit(cache=True, nogil=True, fastmath=True)
def _free(before: Occluders, x_px: float, y_px: float, u: float, v: float, light_px: float) -> np.float32:
    """Return how much of a ray to (x_px, y_px) through (u, v) gets past all that is nearer than a light, walked from the nearest on."""
    coc_px, alpha, nearest_px = before
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
                        _sort_in(around, count, values[y * width + x, c] / alpha)
                        count += 1
            median = 0.5 * (around[(count - 1) // 2] + around[count // 2]) if count else 0.0
            dark[i, c] = min(own[3] * median, own[c])
        if max(own[0], own[1], own[2]) <= ratio * max(dark[i, 0], dark[i, 1], dark[i, 2]):
            for c in range(3):  # a slice would bring numba's texts of errors with it, a second to compile
                dark[i, c] = own[c]


@njit(cache=True, nogil=True)
def _sort_in(ordered: np.ndarray, count: int, value: float) -> None:
    """Put a value in its place among the first `count`, which ascend."""
    while count > 0 and ordered[count - 1] > value:
        ordered[count] = ordered[count - 1]
        count -= 1
    ordered[count] = value
