"""A printed ChArUco board: a chessboard with markers in its white squares, whose corners have known places in metres.

board.toml:
    squares = [8, 6]             # columns, rows
    square_mm = 30.0             # measured on the print, over many squares
    marker_mm = 22.0
    dictionary = "DICT_4X4_50"   # of cv2.aruco
"""

import tomllib
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32, Int, UInt8

from mrbokeh.errors import InputError
from mrbokeh.lens import MM_PER_M

_ENLARGED_UP_TO_PX = 2000
_KEYS = {"squares", "square_mm", "marker_mm", "dictionary"}


@dataclass(frozen=True)
class CharucoBoard:
    """squares: (columns, rows). dictionary: a name in cv2.aruco."""

    squares: tuple[int, int]
    square_m: float
    marker_m: float
    dictionary: str = "DICT_4X4_50"

    def __post_init__(self) -> None:
        if min(self.squares) < 3:
            raise InputError(f"a ChArUco board needs at least 3x3 squares, got {self.squares[0]}x{self.squares[1]}")
        if not 0.0 < self.marker_m < self.square_m < 10.0:
            raise InputError(
                f"a ChArUco board needs 0 < marker < square, got {self.marker_m * MM_PER_M:g} mm and {self.square_m * MM_PER_M:g} mm"
            )
        if not (self.dictionary.startswith("DICT_") and hasattr(cv2.aruco, self.dictionary)):
            raise InputError(f"expected a dictionary of cv2.aruco such as DICT_4X4_50 or DICT_5X5_100, got {self.dictionary!r}")

    @property
    def corners_m(self) -> Float[np.ndarray, "corners 3"]:
        """Places of the inner corners on the board, by their id: x along the columns, y along the rows, z = 0."""
        return np.asarray(self.opencv_board().getChessboardCorners(), np.float64).reshape(-1, 3)

    def opencv_board(self, legacy: bool = False) -> "cv2.aruco.CharucoBoard":
        """legacy: markers as OpenCV before 4.6 printed them where the number of rows is even."""
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        board = cv2.aruco.CharucoBoard(self.squares, self.square_m, self.marker_m, dictionary)
        board.setLegacyPattern(legacy)
        return board

    def detect(self, rgb8: UInt8[np.ndarray, "height width 3"]) -> tuple[Int[np.ndarray, " found"], Float[np.ndarray, "found 2"]]:
        """(ids, positions in px with the centre of the first pixel at (0.5, 0.5)) of the corners seen.

        Both patterns are tried, and with small pictures also enlarged ones, in which small markers are read that were not before.
        """
        grey = cv2.cvtColor(np.ascontiguousarray(rgb8), cv2.COLOR_RGB2GRAY)
        found = []
        for enlarged in (1, 2) if max(grey.shape) <= _ENLARGED_UP_TO_PX else (1,):
            picture = grey if enlarged == 1 else cv2.resize(grey, None, fx=enlarged, fy=enlarged, interpolation=cv2.INTER_CUBIC)
            for legacy in (False, True):
                ids, xy_px = self._detect(picture, legacy)
                found.append((ids, xy_px / enlarged))
        return max(found, key=lambda each: len(each[0]))

    def _detect(self, grey: UInt8[np.ndarray, "height width"], legacy: bool) -> tuple[np.ndarray, np.ndarray]:
        """OpenCV 5 returns (N, 2) and (N,) where 4.x had (N, 1, 2) and (N, 1); its first pixel has its centre at (0, 0)."""
        corners, ids, _, _ = cv2.aruco.CharucoDetector(self.opencv_board(legacy)).detectBoard(grey)
        if ids is None or corners is None or len(ids) == 0:
            return np.zeros(0, np.int64), np.zeros((0, 2))
        places = self._refined(grey, np.asarray(corners, np.float32).reshape(-1, 2))
        return np.asarray(ids, np.int64).ravel(), places.astype(np.float64) + 0.5

    def _refined(self, grey: UInt8[np.ndarray, "height width"], places: Float32[np.ndarray, "found 2"]) -> Float32[np.ndarray, "found 2"]:
        """Corners anew within a window that ends before the markers: OpenCV's own window takes them in, and is 0.17 px off
        where this is 0.02 px off (a traced board with squares of 25 px)."""
        if len(places) < 2:
            return places
        apart = np.linalg.norm(places[:, None] - places, axis=-1)
        square_px = float(np.median(np.sort(apart, axis=1)[:, 1]))
        clear_px = square_px * (1.0 - self.marker_m / self.square_m) / 2.0
        half = int(np.clip(clear_px, 2, 15))
        rule = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
        return cv2.cornerSubPix(grey, places.reshape(-1, 1, 2).copy(), (half, half), (-1, -1), rule).reshape(-1, 2)


def board_from_options(board: str, square_mm: float | None, marker_mm: float | None, dictionary: str) -> CharucoBoard:
    """`board` is "COLUMNSxROWS" with the sizes beside it, or the path of a board.toml."""
    if board.endswith(".toml"):
        return read_board(Path(board))
    try:
        columns, rows = (int(each) for each in board.lower().split("x"))
    except ValueError:
        raise InputError(f"--board must be COLUMNSxROWS such as 8x6, or a board.toml, got {board!r}") from None
    if square_mm is None or marker_mm is None:
        raise InputError("--board COLUMNSxROWS needs --square-mm and --marker-mm as measured on the print")
    return CharucoBoard((columns, rows), square_mm / MM_PER_M, marker_mm / MM_PER_M, dictionary)


def read_board(path: Path) -> CharucoBoard:
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"expected a ChArUco board at {path}, but there is no such file") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not a TOML file: {error}") from None
    unknown = set(document) - _KEYS
    if unknown or not _KEYS - {"dictionary"} <= set(document):
        raise InputError(f"{path}: expected {', '.join(sorted(_KEYS))}, got {', '.join(sorted(document)) or 'nothing'}")
    try:
        columns, rows = (int(each) for each in document["squares"])
        square_m, marker_m = (float(document[key]) / MM_PER_M for key in ("square_mm", "marker_mm"))
    except (TypeError, ValueError) as error:
        raise InputError(f"{path}: expected squares = [columns, rows] and sizes in mm ({error})") from None
    return CharucoBoard((columns, rows), square_m, marker_m, str(document.get("dictionary", "DICT_4X4_50")))
