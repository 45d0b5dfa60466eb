"""Compiled loops of mrbokeh.layering.slices: what covers what, pixels sorted into slices, their light laid out and claimed, components.

Pixels of a layer go by their number; their places, row times width plus column, ascend. A run is a range of numbers in one slice and
one row, without gaps, so that neighbours in memory are worked through together. Components are found on a grid of square cells over
the frame; those loops are so short that releasing the GIL (nogil) would cost more than it saves.
"""

import numpy as np

from mrbokeh.system.compiled import njit


@njit(cache=True)
def mark_cells(cells: np.ndarray, cell_px: int, runs: np.ndarray, places: np.ndarray, width: int) -> None:
    """Set the cells (rows, columns) in which pixels of runs (R, 2) lie to -1."""
    for r in range(len(runs)):
        y, x = places[runs[r, 0]] // width, places[runs[r, 0]] % width
        cells[y // cell_px, x // cell_px : (x + runs[r, 1] - runs[r, 0] - 1) // cell_px + 1] = -1


@njit(cache=True)
def label_components(cells: np.ndarray) -> int:
    """Number the marked cells from 1 on, cells that touch at a side or a corner alike, and return how many numbers there are."""
    rows, columns = cells.shape
    count, stack = 0, np.empty(cells.size, np.int64)
    for start in range(cells.size):
        if cells[start // columns, start % columns] != -1:
            continue
        count += 1
        cells[start // columns, start % columns], stack[0], height = count, start, 1
        while height > 0:
            height -= 1
            y, x = stack[height] // columns, stack[height] % columns
            for ny in range(max(0, y - 1), min(rows, y + 2)):
                for nx in range(max(0, x - 1), min(columns, x + 2)):
                    if cells[ny, nx] == -1:
                        cells[ny, nx], stack[height] = count, ny * columns + nx
                        height += 1
    return count


@njit(cache=True)
def components_of_runs(boxes: np.ndarray, cells: np.ndarray, cell_px: int, runs: np.ndarray, places: np.ndarray, width: int) -> np.ndarray:
    """Return (R,) the component, from 0 on, of each run, and widen boxes (components, 4: first and end row, first and end column) by
    the runs.
    """
    components = np.empty(len(runs), np.int32)
    for r in range(len(runs)):
        y, x = places[runs[r, 0]] // width, places[runs[r, 0]] % width
        components[r] = cells[y // cell_px, x // cell_px] - 1
        box = boxes[components[r]]
        box[0], box[1] = min(box[0], y), max(box[1], y + 1)
        box[2], box[3] = min(box[2], x), max(box[3], x + runs[r, 1] - runs[r, 0])
    return components


@njit(cache=True)
def join_components(boxes: np.ndarray, reach: int, pixels_per_spread: int) -> np.ndarray:
    """Return (components,) the component that each is joined with, itself if none: one window for both costs less than two. Widens
    boxes.
    """
    joined = np.arange(len(boxes))
    changed = True
    while changed:
        changed = False
        for a in range(len(boxes)):
            for b in range(a):
                if joined[a] != a or joined[b] != b:
                    continue
                top, bottom = min(boxes[a, 0], boxes[b, 0]), max(boxes[a, 1], boxes[b, 1])
                left, right = min(boxes[a, 2], boxes[b, 2]), max(boxes[a, 3], boxes[b, 3])
                apart = _area(boxes[a], reach) + _area(boxes[b], reach) + pixels_per_spread
                if (bottom - top + 2 * reach) * (right - left + 2 * reach) <= apart:
                    boxes[b, 0], boxes[b, 1], boxes[b, 2], boxes[b, 3] = top, bottom, left, right
                    joined[a], changed = b, True
    for a in range(len(boxes)):
        joined[a] = joined[joined[a]]
    return joined


@njit(cache=True)
def _area(box: np.ndarray, reach: int) -> int:
    return (box[1] - box[0] + 2 * reach) * (box[3] - box[2] + 2 * reach)


@njit(cache=True, nogil=True)
def cover(
    shown: np.ndarray,
    crossing: np.ndarray,
    free: np.ndarray,
    nearest_px: np.ndarray,
    places: np.ndarray,
    values: np.ndarray,
    coc_px: np.ndarray,
    sharp_px: np.float32,
    first: int,
    end: int,
) -> None:
    """Let pixels of values (N, C), from the first to before an end, cover what is free (H W).

    shown (N,) is set to what was free at their places before; crossing (N,) to the rest, if the pixel lies behind the focus and the nearest
    so far (nearest_px (H W), not above 0) in front of it. Ranges of pixels at different places can be worked through side by side.
    """
    one, nothing = np.float32(1.0), np.float32(0.0)
    for i in range(first, end):
        place, coverage = places[i], values[i, 3]
        shown[i] = free[place]
        crossing[i] = one - free[place] if coc_px[i] > sharp_px and nearest_px[place] < -sharp_px else nothing
        free[place] *= one - coverage
        if coverage > nothing:
            nearest_px[place] = min(nearest_px[place], coc_px[i])


@njit(cache=True, nogil=True, error_model="numpy")
def runs_of_slices(
    places: np.ndarray, coc_px: np.ndarray, shares: np.ndarray, width: int, step_px: np.float32, first: int, end: int
) -> np.ndarray:
    """Return (R, 3): slice, first number and end of each run of pixels that have a share, among the numbers from first to end."""
    slices = np.empty(end - first, np.int32)
    none = np.int32(-(1 << 31))
    for i in range(first, end):
        nearest = np.int32(np.floor(coc_px[i] / step_px + np.float32(0.5)))
        slices[i - first] = nearest if shares[i] > np.float32(0.0) else none
    runs = np.empty((end - first, 3), np.int32)
    count, here, place, row_end = 0, none, 0, 0
    for i in range(first, end):
        if slices[i - first] != here or places[i] != place or place == row_end:
            if here != none:
                runs[count - 1, 2] = i
            here, place = slices[i - first], places[i]
            row_end = place + width - place % width
            if here != none:
                runs[count, 0], runs[count, 1] = here, i
                count += 1
        place += 1
    if here != none:
        runs[count - 1, 2] = end
    return runs[:count].copy()


@njit(cache=True)
def extent(runs: np.ndarray, places: np.ndarray, width: int) -> tuple[int, int, int, int]:
    """Return first and end row, first and end column of runs (R, 2), at least one."""
    left, right = width, 0
    for r in range(len(runs)):
        column = places[runs[r, 0]] % width
        left, right = min(left, column), max(right, column + runs[r, 1] - runs[r, 0])
    return places[runs[0, 0]] // width, places[runs[-1, 0]] // width + 1, left, right


@njit(cache=True, nogil=True)
def place_light(
    light: np.ndarray,
    light_coc_px: np.ndarray,
    runs: np.ndarray,
    places: np.ndarray,
    values: np.ndarray,
    coc_px: np.ndarray,
    shares: np.ndarray,
    width: int,
    top: int,
    left: int,
) -> np.ndarray:
    """Put pixels times their shares into light (h, w, C), a window of the frame, zero where nothing is.

    Pixels outside the window and pixels that cover nothing are left out. Returns the runs of pixels whose place is taken.
    """
    rows, columns, channels = light.shape
    waiting = [0 for _ in range(0)]
    for r in range(len(runs)):
        y, x = places[runs[r, 0]] // width - top, places[runs[r, 0]] % width - left
        first, end = runs[r, 0] + max(0, -x), min(runs[r, 1], runs[r, 0] + columns - x)
        if y < 0 or y >= rows or first >= end:
            continue
        to, coc_px_there, source = light[y, max(0, x) :], light_coc_px[y, max(0, x) :], values[first:end]
        if channels == 4 and _is_free(to[: len(source)].reshape(-1), source.reshape(-1)):
            for i in range(len(source)):
                coc_px_there[i] = coc_px[first + i]
            _put_all(to[: len(source)].reshape(-1), source.reshape(-1), shares[first:end])
            continue
        for i in range(len(source)):
            if to[i, 3] > 0.0:
                waiting.append(first + i)
            elif source[i, 3] > 0.0:
                coc_px_there[i] = coc_px[first + i]
                for c in range(channels):
                    to[i, c] = source[i, c] * shares[first + i]
    late = np.empty((len(waiting), 2), np.int32)
    for i in range(len(waiting)):
        late[i, 0], late[i, 1] = waiting[i], waiting[i] + 1
    return late


@njit(cache=True, nogil=True)
def _is_free(light: np.ndarray, values: np.ndarray) -> bool:
    """Return whether all these pixels of four channels cover something, and their places are empty."""
    least, most = np.float32(np.inf), np.float32(0.0)
    for i in range(3, len(values), 4):
        least, most = min(least, values[i]), max(most, light[i])
    return bool(least > 0.0 and most == 0.0)


@njit(cache=True, nogil=True)
def _put_all(light: np.ndarray, values: np.ndarray, shares: np.ndarray) -> None:
    """Set pixels of four channels times their shares, without a branch so that it vectorises."""
    for i in range(len(shares)):
        for c in range(4):
            light[4 * i + c] = values[4 * i + c] * shares[i]


@njit(cache=True, nogil=True)
def remove_light(
    light: np.ndarray, light_coc_px: np.ndarray, runs: np.ndarray, places: np.ndarray, width: int, top: int, left: int
) -> None:
    """Make light zero again where runs of pixels were put."""
    rows, columns, _ = light.shape
    for r in range(len(runs)):
        y, x = places[runs[r, 0]] // width - top, places[runs[r, 0]] % width - left
        if 0 <= y < rows:
            first, end = max(0, x), min(columns, x + runs[r, 1] - runs[r, 0])
            light_coc_px[y, first:end] = 0.0
            light[y, first:end] = 0.0


@njit(cache=True, nogil=True)
def claim(colour: np.ndarray, taken: np.ndarray, light: np.ndarray, top: int, left: int) -> None:
    """Add light (h, w, 3 + K + E) to colour (H, W, 3 + E) as far as the pupil is still free, and its coverage to taken (H, W, K), K 1 or
    3.

    The light's first row and column are `top` and `left` in the frame, which may lie outside; what falls outside is lost.
    """
    height, width, colours = colour.shape
    first, end = max(0, left), min(width, left + light.shape[1])
    for y in range(max(0, top), min(height, top + light.shape[0])):
        colours_here, taken_here, rays = colour[y, first:end], taken[y, first:end], light[y - top, first - left : end - left]
        if colours == 3 and taken.shape[2] == 1:
            _claim_row(colours_here.reshape(-1), taken_here.reshape(-1), rays.reshape(-1))
        else:
            _claim_any_row(colours_here, taken_here, rays)


@njit(cache=True, nogil=True)
def _claim_row(colour: np.ndarray, taken: np.ndarray, light: np.ndarray) -> None:
    """Claim for pixels of R, G, B and one coverage, without a branch so that it vectorises."""
    one, nothing = np.float32(1.0), np.float32(0.0)
    for x in range(len(taken)):
        coverage = light[4 * x + 3]
        share = min(one, (one - taken[x]) / coverage) if coverage > nothing else nothing
        colour[3 * x] += light[4 * x] * share
        colour[3 * x + 1] += light[4 * x + 1] * share
        colour[3 * x + 2] += light[4 * x + 2] * share
        taken[x] = min(one, taken[x] + max(nothing, coverage))


@njit(cache=True, nogil=True)
def _claim_any_row(colour: np.ndarray, taken: np.ndarray, light: np.ndarray) -> None:
    """Claim for each colour by its own coverage, or for all by the only one; other channels go with green."""
    width, colours = colour.shape
    kinds = taken.shape[1]
    for x in range(width):
        for kind in range(kinds):
            coverage = light[x, 3 + kind]
            if coverage <= 0.0:
                continue
            share = min(np.float32(1.0), (np.float32(1.0) - taken[x, kind]) / coverage)
            for c in range(kind, 3, kinds):
                colour[x, c] += light[x, c] * share
            if kind == kinds // 2:
                for c in range(3, colours):
                    colour[x, c] += light[x, c + kinds] * share
            taken[x, kind] = min(np.float32(1.0), taken[x, kind] + coverage)


@njit(cache=True, nogil=True, error_model="numpy")
def share_out(colour: np.ndarray, taken: np.ndarray, least: np.float32) -> None:
    """Divide colour (H, W, 3 + E) by what is taken (H, W, K), at least `least`; taken becomes 1."""
    height, width, colours = colour.shape
    kinds = taken.shape[2]
    for y in range(height):
        if colours == 3 and kinds == 1:
            row, shares = colour[y].reshape(-1), taken[y].reshape(-1)
            for x in range(width):
                share = max(shares[x], least)
                row[3 * x], row[3 * x + 1], row[3 * x + 2] = row[3 * x] / share, row[3 * x + 1] / share, row[3 * x + 2] / share
        else:
            for x in range(width):
                for c in range(colours):
                    colour[y, x, c] /= max(taken[y, x, min(c, kinds - 1) if c < 3 else kinds // 2], least)
        taken[y] = 1.0
