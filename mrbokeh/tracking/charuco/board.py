"""A printed board to track and measure by: one or more ChArUco grids; of different scale, so that one of them outlives any defocus.

A ChArUco grid is a chessboard with a marker in each white square (Garrido-Jurado et al. 2014; corners of squares are saddle
points, which defocus does not move, as it does the corners of markers). Board axes are those of OpenCV: x right, y down, z into
the paper; the origin is the outer corner of the top left square of a grid at offset (0, 0).
"""

from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, Int64

from mrbokeh.optics.lens import MM_PER_M
from mrbokeh.system.errors import InputError

FEWEST_SQUARES = 3
DICTIONARY = "DICT_4X4_50"


@dataclass(frozen=True)
class CharucoGrid:
    """squares: (columns, rows). offset_mm: (x, y) of its outer top left corner on the board. first_marker: the lowest id of its markers."""

    squares: tuple[int, int]
    square_mm: float
    marker_mm: float
    offset_mm: tuple[float, float] = (0.0, 0.0)
    first_marker: int = 0

    def __post_init__(self) -> None:
        if min(self.squares) < FEWEST_SQUARES:
            raise InputError(f"a ChArUco grid needs at least 3x3 squares, got {self.squares[0]}x{self.squares[1]}")
        if not 0.0 < self.marker_mm < self.square_mm <= 10 * MM_PER_M:
            raise InputError(
                f"a ChArUco grid needs 0 < marker < square, got a marker of {self.marker_mm:g} mm and a square of {self.square_mm:g} mm"
            )
        if min(self.offset_mm) < 0 or self.first_marker < 0:
            raise InputError(f"a ChArUco grid needs an offset and marker ids from 0 up, got {self.offset_mm} mm and {self.first_marker}")

    @property
    def size_mm(self) -> tuple[float, float]:
        return self.squares[0] * self.square_mm, self.squares[1] * self.square_mm

    @property
    def marker_ids(self) -> range:
        """One for each white square, row by row."""
        return range(self.first_marker, self.first_marker + self.squares[0] * self.squares[1] // 2)

    @property
    def box_mm(self) -> tuple[float, float, float, float]:
        """Left, top, right, bottom on the board."""
        (x, y), (width, height) = self.offset_mm, self.size_mm
        return x, y, x + width, y + height


@dataclass(frozen=True)
class CharucoBoard:
    """dictionary: a name in cv2.aruco. Ids of corners count through the grids in their order.

    legacy: printed by OpenCV before 4.6, which began with a white square where the number of rows is even.
    """

    grids: tuple[CharucoGrid, ...]
    dictionary: str = DICTIONARY
    legacy: bool = False

    def __post_init__(self) -> None:
        if not self.grids:
            raise InputError("a board needs at least one ChArUco grid, but came with none")
        if not (self.dictionary.startswith("DICT_") and hasattr(cv2.aruco, self.dictionary)):
            raise InputError(f"expected a dictionary of cv2.aruco such as DICT_4X4_50 or DICT_5X5_100, got {self.dictionary!r}")
        highest, known = max(grid.marker_ids.stop for grid in self.grids), len(self.opencv_dictionary().bytesList)
        if highest > known:
            raise InputError(
                f"the board needs {highest} markers, but {self.dictionary} has {known}: use a larger dictionary or fewer squares"
            )
        for one, other in combinations(self.grids, 2):
            _require_apart(one, other)

    @property
    def size_mm(self) -> tuple[float, float]:
        """From the origin to the right and lower end."""
        return max(grid.box_mm[2] for grid in self.grids), max(grid.box_mm[3] for grid in self.grids)

    @cached_property
    def corners_m(self) -> Float64[np.ndarray, "corners 3"]:
        """Places of all inner corners, by id; z = 0."""
        return np.concatenate([_corners_mm(grid) for grid in self.grids]) / MM_PER_M

    @cached_property
    def grid_of_corner(self) -> Int64[np.ndarray, " corners"]:
        """Which grid each corner belongs to."""
        return np.repeat(np.arange(len(self.grids)), [len(_corners_mm(grid)) for grid in self.grids])

    @property
    def squares_text(self) -> str:
        """For sentences: 8x6, or 4x3 and 9x5."""
        return " and ".join(f"{columns}x{rows}" for columns, rows in (grid.squares for grid in self.grids))

    def begins_white(self, grid: int) -> bool:
        """Whether the top left square of a grid is white."""
        return self.legacy and self.grids[grid].squares[1] % 2 == 0

    def opencv_dictionary(self) -> Any:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))

    def opencv_board(self, grid: int) -> Any:
        """One grid for OpenCV, in millimetres from its own corner."""
        it = self.grids[grid]
        ids = np.array(it.marker_ids, np.int32)
        board = cv2.aruco.CharucoBoard(it.squares, it.square_mm, it.marker_mm, self.opencv_dictionary(), ids)
        board.setLegacyPattern(self.legacy)
        return board


def _corners_mm(grid: CharucoGrid) -> Float64[np.ndarray, "corners 3"]:
    """Row by row, as OpenCV numbers them."""
    columns, rows = np.meshgrid(np.arange(1, grid.squares[0]), np.arange(1, grid.squares[1]))
    xy = np.stack([columns.ravel(), rows.ravel()], axis=1) * grid.square_mm + np.asarray(grid.offset_mm)
    return np.pad(xy, ((0, 0), (0, 1)))


def _require_apart(one: CharucoGrid, other: CharucoGrid) -> None:
    if set(one.marker_ids) & set(other.marker_ids):
        raise InputError(
            f"two grids of a board share marker ids (from {one.first_marker} and {other.first_marker}): "
            f"let first_marker of one begin after the markers of the other"
        )
    left, top, right, bottom = one.box_mm
    x, y, x_end, y_end = other.box_mm
    if left < x_end and x < right and top < y_end and y < bottom:
        raise InputError(f"two grids of a board overlap, at {one.offset_mm} and {other.offset_mm} mm: move one with offset_mm")
