"""A board as JSON, or as TOML with the same keys.

    {"dictionary": "DICT_4X4_50",
     "grids": [{"squares": [8, 6], "square_mm": 20.0, "marker_mm": 15.0, "offset_mm": [0, 0], "first_marker": 0}],
     "legacy": false,
     "black_mm": [[x, y, width, height], ...]}

legacy: see CharucoBoard. black_mm is there for whoever draws the board; it is not read. A board.toml of one grid needs no table:

    squares = [8, 6]             # columns, rows
    square_mm = 30.0             # measured on the print, over many squares
    marker_mm = 22.0
    dictionary = "DICT_4X4_50"   # of cv2.aruco
"""

import tomllib
from pathlib import Path
from typing import Any

from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.charuco.board import DICTIONARY, CharucoBoard, CharucoGrid
from mrbokeh.tracking.charuco.drawing import black_rectangles_mm

_KEYS = {"dictionary", "grids", "legacy", "black_mm"}
_OF_BOARD = _KEYS - {"grids"}
_WHAT = "a ChArUco board"
_GRID_KEYS = {"squares", "square_mm", "marker_mm", "offset_mm", "first_marker"}


def write_board(path: Path | str, board: CharucoBoard) -> None:
    write_json(path, board_to_json(board))


def read_board(path: Path | str) -> CharucoBoard:
    """JSON, or TOML by the suffix."""
    document = _read_toml(Path(path)) if Path(path).suffix.lower() == ".toml" else read_json(path, _WHAT)
    return board_from_json(document, str(path))


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"expected {_WHAT} at {path}, but there is no such file") from None
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
