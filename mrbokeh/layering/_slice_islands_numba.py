"""The loops of mrbokeh.layering.slice_islands, compiled: a grid of square cells lies over the frame; runs are those of slice_sorting.

So little work that other threads need not be let in meanwhile, as nogil would: to get back among them takes longer.
"""

import numpy as np

from mrbokeh.system.kernels import njit


@njit(cache=True)
def mark_cells(cells: np.ndarray, cell_px: int, runs: np.ndarray, places: np.ndarray, width: int) -> None:
    """Set the cells (rows, columns) in which pixels of runs (R, 2) lie to -1."""
    for r in range(len(runs)):
        y, x = places[runs[r, 0]] // width, places[runs[r, 0]] % width
        cells[y // cell_px, x // cell_px : (x + runs[r, 1] - runs[r, 0] - 1) // cell_px + 1] = -1


@njit(cache=True)
def number_islands(cells: np.ndarray) -> int:
    """Number marked cells from 1 on, those that touch at a side or a corner alike; how many numbers there are."""
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
def islands_of_runs(boxes: np.ndarray, cells: np.ndarray, cell_px: int, runs: np.ndarray, places: np.ndarray, width: int) -> np.ndarray:
    """(R,) which island, from 0 on, each run belongs to; widens boxes (islands, 4: first and end row, first and end column) by them."""
    islands = np.empty(len(runs), np.int32)
    for r in range(len(runs)):
        y, x = places[runs[r, 0]] // width, places[runs[r, 0]] % width
        islands[r] = cells[y // cell_px, x // cell_px] - 1
        box = boxes[islands[r]]
        box[0], box[1] = min(box[0], y), max(box[1], y + 1)
        box[2], box[3] = min(box[2], x), max(box[3], x + runs[r, 1] - runs[r, 0])
    return islands


@njit(cache=True)
def join_islands(boxes: np.ndarray, reach: int, pixels_per_spread: int) -> np.ndarray:
    """(islands,) which other island, or itself, each is joined with, where one window for both costs less than two; boxes are widened."""
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
