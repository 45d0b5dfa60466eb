"""Printed boards to track and measure by: ChArUco grids, of different scale so that one of them outlives any defocus; their files.

A ChArUco grid is a chessboard with a marker in each white square (Garrido-Jurado et al. 2014; corners of squares are saddle
points, which defocus does not move, as it does the corners of markers). Board axes are those of OpenCV: x right, y down, z into
the paper; the origin is the outer corner of the top left square of a grid at offset (0, 0).

A board is kept as JSON, or as TOML with the same keys:

    {"dictionary": "DICT_4X4_50",
     "grids": [{"squares": [8, 6], "square_mm": 20.0, "marker_mm": 15.0, "offset_mm": [0, 0], "first_marker": 0}],
     "legacy": false,
     "black_mm": [[x, y, width, height], ...]}

black_mm is there for whoever draws the board; it is not read. A board.toml of one grid needs no table:

    squares = [8, 6]             # columns, rows
    square_mm = 30.0             # measured on the print, over many squares
    marker_mm = 22.0
    dictionary = "DICT_4X4_50"   # of cv2.aruco
"""

import tomllib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64

from mrbokeh.optics.lens import MM_PER_M
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError, require_file

FEWEST_SQUARES = 3
DICTIONARY = "DICT_4X4_50"


@dataclass(frozen=True)
class CharucoGrid:
    """Chessboard with markers.

    squares: (columns, rows). offset_mm: (x, y) of its outer top left corner on the board. first_marker: the lowest id of its markers.
    """

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
        """Return the marker of each white square, row by row."""
        return range(self.first_marker, self.first_marker + self.squares[0] * self.squares[1] // 2)

    @property
    def box_mm(self) -> tuple[float, float, float, float]:
        """Return left, top, right and bottom on the board."""
        (x, y), (width, height) = self.offset_mm, self.size_mm
        return x, y, x + width, y + height


@dataclass(frozen=True)
class CharucoBoard:
    """Board of one or more grids.

    dictionary: a name in cv2.aruco. Ids of corners count through the grids in their order.

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
        """Return (width, height) from the origin to the right and lower end."""
        return max(grid.box_mm[2] for grid in self.grids), max(grid.box_mm[3] for grid in self.grids)

    @cached_property
    def corners_m(self) -> Float64[np.ndarray, "corners 3"]:
        """Return the places of all inner corners, by id; z = 0."""
        return np.concatenate([_corners_mm(grid) for grid in self.grids]) / MM_PER_M

    @cached_property
    def grid_of_corner(self) -> Int64[np.ndarray, " corners"]:
        """Return the grid that each corner belongs to."""
        return np.repeat(np.arange(len(self.grids)), [len(_corners_mm(grid)) for grid in self.grids])

    @property
    def squares_text(self) -> str:
        """Return the squares for messages: 8x6, or 4x3 and 9x5."""
        return " and ".join(f"{columns}x{rows}" for columns, rows in (grid.squares for grid in self.grids))

    @property
    def described(self) -> str:
        """Return what it is, for messages."""
        return f"the board ({self.squares_text} squares, {self.dictionary})"

    def begins_white(self, grid: int) -> bool:
        """Return whether the top left square of a grid is white."""
        return self.legacy and self.grids[grid].squares[1] % 2 == 0

    def opencv_dictionary(self) -> Any:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))

    def opencv_board(self, grid: int) -> Any:
        """Return one grid for OpenCV, in millimetres from its own corner."""
        it = self.grids[grid]
        ids = np.array(it.marker_ids, np.int32)
        board = cv2.aruco.CharucoBoard(it.squares, it.square_mm, it.marker_mm, self.opencv_dictionary(), ids)
        board.setLegacyPattern(self.legacy)
        return board


def _corners_mm(grid: CharucoGrid) -> Float64[np.ndarray, "corners 3"]:
    """Return corners row by row, as OpenCV numbers them."""
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


Rectangle = tuple[float, float, float, float]


def black_rectangles_mm(board: CharucoBoard) -> Float64[np.ndarray, "rectangles 4"]:
    """Return x, y (of the top left corner, y down), width and height of what is printed black; rectangles touch but do not overlap."""
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
    """Return the cells of a marker with its black border of one cell, row by row."""
    dictionary = board.opencv_dictionary()
    return dictionary.generateImageMarker(marker, dictionary.markerSize + 2, None, 1) == 0


def _of_marker(black: Bool[np.ndarray, "cells cells"], x: float, y: float, side: float) -> Iterator[Rectangle]:
    """Yield the rectangles of a marker; neighbours in a row become one."""
    cell = side / len(black)
    for row, cells in enumerate(black):
        ends = np.flatnonzero(np.diff(np.pad(cells.astype(np.int8), 1)))
        for begin, end in ends.reshape(-1, 2):
            yield x + float(begin) * cell, y + row * cell, float(end - begin) * cell, cell


_KEYS = {"dictionary", "grids", "legacy", "black_mm"}
_OF_BOARD = _KEYS - {"grids"}
_WHAT = "a ChArUco board"
_GRID_KEYS = {"squares", "square_mm", "marker_mm", "offset_mm", "first_marker"}


def write_board(path: Path | str, board: CharucoBoard) -> None:
    write_json(path, board_to_json(board))


def read_board(path: Path | str) -> CharucoBoard:
    """Read a board from JSON, or TOML by the suffix."""
    document = _read_toml(Path(path)) if Path(path).suffix.lower() == ".toml" else read_json(path, _WHAT)
    return board_from_json(document, str(path))


def _read_toml(path: Path) -> dict[str, Any]:
    require_file(path, _WHAT)
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"expected {_WHAT} at {path}, but it is not TOML: {error}") from None
    if "grids" in document:
        return document
    of_board = {key: value for key, value in document.items() if key in _OF_BOARD}
    return {**of_board, "grids": [{key: value for key, value in document.items() if key not in _OF_BOARD}]}


def board_to_json(board: CharucoBoard) -> dict[str, Any]:
    grids = [
        {
            "squares": list(grid.squares),
            "square_mm": grid.square_mm,
            "marker_mm": grid.marker_mm,
            "offset_mm": list(grid.offset_mm),
            "first_marker": grid.first_marker,
        }
        for grid in board.grids
    ]
    black_mm = black_rectangles_mm(board).round(6).tolist()
    return {"dictionary": board.dictionary, "grids": grids, "legacy": board.legacy, "black_mm": black_mm}


def board_from_json(document: Any, where: str) -> CharucoBoard:
    if not isinstance(document, dict) or not isinstance(document.get("grids"), list) or set(document) - _KEYS:
        raise InputError(f"{where}: expected a ChArUco board with grids and a dictionary, got {_what(document)}")
    grids = tuple(_grid(each, f"{where}, grid {number}") for number, each in enumerate(document["grids"], 1))
    return CharucoBoard(grids, str(document.get("dictionary", DICTIONARY)), bool(document.get("legacy", False)))


def _grid(document: Any, where: str) -> CharucoGrid:
    if not isinstance(document, dict) or set(document) - _GRID_KEYS:
        raise InputError(f"{where}: expected {', '.join(sorted(_GRID_KEYS))}, got {_what(document)}")
    try:
        columns, rows = (int(each) for each in document["squares"])
        x_mm, y_mm = (float(each) for each in document.get("offset_mm", (0.0, 0.0)))
        sizes = float(document["square_mm"]), float(document["marker_mm"])
        return CharucoGrid((columns, rows), *sizes, (x_mm, y_mm), int(document.get("first_marker", 0)))
    except (KeyError, TypeError) as error:
        raise InputError(f"{where}: expected squares = [columns, rows], square_mm and marker_mm ({error!r})") from None
    except InputError as error:
        raise InputError(f"{where}: {error}") from None
    except ValueError as error:
        raise InputError(f"{where}: expected squares = [columns, rows] and sizes in mm ({error})") from None


def _what(document: Any) -> str:
    return ", ".join(sorted(document)) or "nothing" if isinstance(document, dict) else type(document).__name__
