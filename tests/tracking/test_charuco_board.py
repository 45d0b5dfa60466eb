"""What capture and viewfinder share about boards: the older pattern of OpenCV, and files that either of them reads."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid, black_rectangles_mm, read_board, write_board
from mrbokeh.tracking.charuco.detector import CharucoDetector
from tests.support.refusals import refused

EVEN = CharucoBoard((CharucoGrid((5, 4), 24.0, 18.0),), legacy=True)
ODD = CharucoBoard((CharucoGrid((4, 5), 24.0, 18.0),), legacy=True)


def drawn(board: CharucoBoard) -> np.ndarray:
    """2 px per mm: all edges lie on pixels."""
    picture = np.full([round(2 * side) for side in board.size_mm[::-1]], 255, np.uint8)
    for x, y, width, height in (2 * black_rectangles_mm(board)).round().astype(int):
        picture[y : y + height, x : x + width] = 0
    return picture


@pytest.mark.parametrize("board", [EVEN, ODD, replace(EVEN, legacy=False)])
def test_boards_are_drawn_as_opencv_draws_them(board: CharucoBoard) -> None:
    """Squares of 48 px, cells of 6 px: OpenCV's own drawing has nothing to round. Only an even number of rows began with white."""
    picture = drawn(board)
    np.testing.assert_array_equal(picture, board.opencv_board(0).generateImage(picture.shape[::-1], marginSize=0))
    assert np.array_equal(picture, drawn(replace(board, legacy=False))) == (board is not EVEN)


def test_each_pattern_is_found_by_its_own_detector_only_however_it_is_searched() -> None:
    """48 px a square and 40 of white paper around: inner corner (i, j) lies at 40 + 48 (i, j)."""
    picture = np.pad(drawn(EVEN), 40, constant_values=255)
    detector = CharucoDetector(EVEN)
    assert len(CharucoDetector(replace(EVEN, legacy=False)).detect(picture)) < 12
    for found in (detector.detect(picture), *(detector.detect_enlarged(picture, enlarged) for enlarged in (1, 2, 3))):
        assert len(found) == 12
        np.testing.assert_allclose(found.xy_px, 40.0 + 2000.0 * EVEN.corners_m[found.ids, :2], atol=0.03)


def test_json_and_toml_tell_of_the_same_board(tmp_path: Path) -> None:
    (tmp_path / "short.toml").write_text('squares = [5, 4]\nsquare_mm = 24\nmarker_mm = 18\ndictionary = "DICT_4X4_50"\nlegacy = true\n')
    (tmp_path / "long.toml").write_text("legacy = true\n[[grids]]\nsquares = [5, 4]\nsquare_mm = 24.0\nmarker_mm = 18.0\n")
    write_board(tmp_path / "board.json", EVEN)
    assert [read_board(tmp_path / name) for name in ("short.toml", "long.toml", "board.json")] == [EVEN] * 3


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("squares = [5, 4]\nsquare_mm = 24.0\n", "grid 1: expected squares .*'marker_mm'"),
        ("squares = 5\nsquare_mm = 24.0\nmarker_mm = 18.0\n", "grid 1: expected squares"),
        ("squares = [5, 4]\nsquare_mm = 24.0\nmarker_mm = 18.0\ncolour = 1\n", "got colour, marker_mm"),
        ("squares = [5\n", "but it is not TOML"),
    ],
)
def test_what_is_no_board_is_refused_with_a_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "board.toml").write_text(text)
    refused(sentence, read_board, tmp_path / "board.toml")
