"""The board that lies in a scene, as the command line names it."""

from pathlib import Path

from mrbokeh.system.errors import InputError
from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid
from mrbokeh.tracking.charuco.board_file import read_board


def board_from_options(board: str, square_mm: float | None, marker_mm: float | None, dictionary: str) -> CharucoBoard:
    """`board` is "COLUMNSxROWS" with the sizes beside it, or the path of a board.toml or board.json."""
    if board.endswith((".toml", ".json")):
        return read_board(Path(board))
    try:
        columns, rows = (int(each) for each in board.lower().split("x"))
    except ValueError:
        raise InputError(f"--board must be COLUMNSxROWS such as 8x6, a board.toml or a board.json, got {board!r}") from None
    if square_mm is None or marker_mm is None:
        raise InputError("--board COLUMNSxROWS needs --square-mm and --marker-mm as measured on the print")
    return CharucoBoard((CharucoGrid((columns, rows), square_mm, marker_mm),), dictionary)
