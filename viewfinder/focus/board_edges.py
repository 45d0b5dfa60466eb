"""The straight edges between the black and white squares of a tracking board: where their blur can be measured."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.lens import MM_PER_M
from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid

# Of an edge only the middle is used: towards its ends the squares change colour.
_USED = 0.4


@dataclass(frozen=True)
class BoardEdges:
    """On the board, in metres, z = 0. starts, ends: of the part to be used. to_white: unit vectors across, towards the white square.

    clear_m: how wide the white is, up to the marker; border_m: how wide the black border of the marker is behind it.
    """

    starts_m: Float64[np.ndarray, "edges 3"]
    ends_m: Float64[np.ndarray, "edges 3"]
    to_white: Float64[np.ndarray, "edges 3"]
    clear_m: Float64[np.ndarray, " edges"]
    border_m: Float64[np.ndarray, " edges"]


def board_edges(board: CharucoBoard) -> BoardEdges:
    """Of all grids, each inner edge once."""
    cells = int(board.opencv_dictionary().markerSize) + 2
    rows = np.array([row for grid in board.grids for row in _edges_mm(grid, cells)], np.float64)
    flat = np.pad(rows[:, :6].reshape(-1, 3, 2), ((0, 0), (0, 0), (0, 1)))
    return BoardEdges(flat[:, 0] / MM_PER_M, flat[:, 1] / MM_PER_M, flat[:, 2], rows[:, 6] / MM_PER_M, rows[:, 7] / MM_PER_M)


def _edges_mm(grid: CharucoGrid, cells: int) -> Iterator[tuple[float, ...]]:
    """(start x, y, end x, y, to white x, y, clear, border) of each; the square in column c, row r is black where c + r is even."""
    columns, rows = grid.squares
    size, (left, top) = grid.square_mm, grid.offset_mm
    clear, border = (size - grid.marker_mm) / 2.0, grid.marker_mm / cells
    first, last = (1.0 - _USED) / 2.0 * size, (1.0 + _USED) / 2.0 * size
    for row in range(rows):
        for column in range(columns):
            x, y = left + column * size, top + row * size
            sign = -1.0 if (column + row) % 2 else 1.0  # from a black square its neighbours are white
            if column + 1 < columns:
                yield x + size, y + first, x + size, y + last, sign, 0.0, clear, border
            if row + 1 < rows:
                yield x + first, y + size, x + last, y + size, 0.0, sign, clear, border
