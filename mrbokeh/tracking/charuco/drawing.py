"""Which rectangles of a board are black, in millimetres: what is printed, and what pictures of it are traced from."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Bool, Float64

from mrbokeh.tracking.charuco.board import CharucoBoard

Rectangle = tuple[float, float, float, float]


def black_rectangles_mm(board: CharucoBoard) -> Float64[np.ndarray, "rectangles 4"]:
    """x, y (of the top left corner, y down), width, height; they touch but do not overlap."""
    return np.array([rectangle for index in range(len(board.grids)) for rectangle in _of_grid(board, index)])


def _of_grid(board: CharucoBoard, index: int) -> Iterator[Rectangle]:
    grid, first_black = board.grids[index], int(board.begins_white(index))
    columns, rows = grid.squares
    ids, side = iter(grid.marker_ids), grid.square_mm
    for row in range(rows):
        for column in range(columns):
            x, y = grid.offset_mm[0] + column * side, grid.offset_mm[1] + row * side
            if (row + column) % 2 == first_black:
                yield x, y, side, side
            else:
                inset = (side - grid.marker_mm) / 2
                yield from _of_marker(marker_is_black(board, next(ids)), x + inset, y + inset, grid.marker_mm)


def marker_is_black(board: CharucoBoard, marker: int) -> Bool[np.ndarray, "cells cells"]:
    """The cells of a marker with its black border of one cell, row by row."""
    dictionary = board.opencv_dictionary()
    return dictionary.generateImageMarker(marker, dictionary.markerSize + 2, None, 1) == 0


def _of_marker(black: Bool[np.ndarray, "cells cells"], x: float, y: float, side: float) -> Iterator[Rectangle]:
    """Neighbours in a row become one rectangle."""
    cell = side / len(black)
    for row, cells in enumerate(black):
        ends = np.flatnonzero(np.diff(np.pad(cells.astype(np.int8), 1)))
        for begin, end in ends.reshape(-1, 2):
            yield x + float(begin) * cell, y + row * cell, float(end - begin) * cell, cell
