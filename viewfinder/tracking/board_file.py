"""A tracking board as JSON.

    {"dictionary": "DICT_4X4_50",
     "grids": [{"squares": [8, 6], "square_mm": 20.0, "marker_mm": 15.0, "offset_mm": [0, 0], "first_marker": 0}],
     "black_mm": [[x, y, width, height], ...]}

black_mm is there for whoever draws the board; it is not read.
"""

from pathlib import Path
from typing import Any

from mrbokeh.atomic_files import read_json, write_json
from mrbokeh.errors import InputError
from viewfinder.tracking.board_drawing import black_rectangles_mm
from viewfinder.tracking.charuco_board import DICTIONARY, CharucoGrid, TrackingBoard

_KEYS = {"dictionary", "grids", "black_mm"}
_GRID_KEYS = {"squares", "square_mm", "marker_mm", "offset_mm", "first_marker"}


def write_board(path: Path | str, board: TrackingBoard) -> None:
    write_json(path, board_to_json(board))


def read_board(path: Path | str) -> TrackingBoard:
    return board_from_json(read_json(path, "a tracking board"), str(path))


def board_to_json(board: TrackingBoard) -> dict[str, Any]:
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
    return {"dictionary": board.dictionary, "grids": grids, "black_mm": black_rectangles_mm(board).round(6).tolist()}


def board_from_json(document: Any, where: str) -> TrackingBoard:
    if not isinstance(document, dict) or not isinstance(document.get("grids"), list) or set(document) - _KEYS:
        raise InputError(f"{where}: expected a tracking board with grids and a dictionary, got {_what(document)}")
    grids = tuple(_grid(each, f"{where}, grid {number}") for number, each in enumerate(document["grids"], 1))
    return TrackingBoard(grids, str(document.get("dictionary", DICTIONARY)))


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
