"""The board to track by: what is printed is what is looked for, in true millimetres."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_scripts.charuco_clip import HandHeld, Sheet, pack_table, trace_sheet
from mrbokeh.images.color import display_rgb8
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.tracking.camera_track.board_calibration import calibrated
from mrbokeh.tracking.charuco import board as boards
from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid, black_rectangles_mm, board_from_json, board_to_json
from mrbokeh.tracking.charuco.detector import CharucoDetector
from tests.support.refusals import refused
from tests.support.traced_board_clip import BOARD, tilted_views
from viewfinder.tracking.printed_board import MARGIN_MM, BoardView, page_for, plan_board, write_board_pdf

SIMPLE = CharucoBoard((CharucoGrid((5, 4), 24.0, 18.0),))
POINTS_PER_MM = 72.0 / 25.4


def rasterised(rectangles_mm: np.ndarray, size_mm: tuple[float, float], px_per_mm: int) -> np.ndarray:
    """Black on white; exact where all edges lie on pixels."""
    picture = np.full((round(size_mm[1] * px_per_mm), round(size_mm[0] * px_per_mm)), 255, np.uint8)
    for x, y, width, height in (rectangles_mm * px_per_mm).round().astype(int):
        picture[y : y + height, x : x + width] = 0
    return picture


def test_corners_lie_where_opencv_has_them_and_those_of_the_second_grid_are_moved_by_its_offset() -> None:
    theirs = np.asarray(SIMPLE.opencv_board(0).getChessboardCorners()).reshape(-1, 3) / 1000.0
    np.testing.assert_allclose(SIMPLE.corners_m, theirs, atol=1e-9)
    first_of_second = BOARD.corners_m[np.flatnonzero(BOARD.grid_of_corner == 1)[0]]
    np.testing.assert_allclose(first_of_second, (0.020, 0.163, 0.0), atol=1e-12)
    assert len(BOARD.corners_m) == 3 * 2 + 8 * 4


def test_rectangles_do_not_overlap() -> None:
    """Their areas add up to the black pixels: 10 px per mm, all edges on pixels."""
    rectangles = black_rectangles_mm(SIMPLE)
    black_mm2 = (rasterised(rectangles, SIMPLE.size_mm, 10) == 0).sum() / 100.0
    assert (rectangles[:, 2] * rectangles[:, 3]).sum() == pytest.approx(black_mm2)


def test_json_keeps_the_board(tmp_path: Path) -> None:
    boards.write_board(tmp_path / "board.json", BOARD)
    assert boards.read_board(tmp_path / "board.json") == BOARD
    assert len(json.loads((tmp_path / "board.json").read_text())["black_mm"]) == len(black_rectangles_mm(BOARD))


def test_what_is_no_board_is_refused_with_a_sentence() -> None:
    plain = {"squares": [5, 4], "square_mm": 20.0, "marker_mm": 15.0}
    for change, sentence in (
        ({"grids": []}, "at least one ChArUco grid"), ({"grids": [{"squares": [5, 4]}]}, "grid 1: expected squares"),
        ({"grids": [plain | {"squares": [2, 4]}]}, "at least 3x3 squares"), ({"dictionary": "DICT_9X9"}, "DICT_4X4_50"),
        ({"grids": [plain | {"colour": 1}]}, "colour"), ({"grids": [plain | {"marker_mm": 25.0}]}, "0 < marker < square"),
        ({"dictionary": "DICT_4X4_50", "grids": [plain | {"squares": [12, 11]}]}, "66 markers"),
        ({"squares": [5, 4]}, "expected a ChArUco board"),
    ):  # fmt: skip
        refused(re.escape(sentence), board_from_json, {**board_to_json(SIMPLE), **change}, "board.json")


def test_grids_must_not_share_markers_or_paper() -> None:
    one = CharucoGrid((4, 4), 20.0, 15.0)
    refused("share marker ids", CharucoBoard, (one, CharucoGrid((4, 4), 20.0, 15.0, (0.0, 90.0), 7)))
    refused("overlap", CharucoBoard, (one, CharucoGrid((4, 4), 20.0, 15.0, (79.0, 0.0), 8)))
    assert CharucoBoard((one, CharucoGrid((4, 4), 20.0, 15.0, (80.0, 0.0), 8))).size_mm == (160.0, 80.0)


def drawn_in(pdf: bytes) -> tuple[np.ndarray, tuple[float, float]]:
    """(the rectangles drawn in it in millimetres from the top left corner of the page, the size of the page)."""
    _, _, width, height = (float(each) / POINTS_PER_MM for each in re.search(rb"MediaBox \[([^\]]*)\]", pdf)[1].split())  # type: ignore[index]
    found = re.findall(rb"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re", pdf)
    rectangles = np.array(found, dtype=np.float64) / POINTS_PER_MM
    rectangles[:, 1] = height - rectangles[:, 1] - rectangles[:, 3]
    return rectangles, (width, height)


def test_the_pdf_draws_the_board_at_true_size_and_its_picture_is_found_there(tmp_path: Path) -> None:
    write_board_pdf(tmp_path / "board.pdf", BOARD, "a4")
    rectangles, page_mm = drawn_in((tmp_path / "board.pdf").read_bytes())
    assert page_mm == pytest.approx((210.0, 297.0), abs=0.01)
    moved = rectangles - [(210.0 - 184.0) / 2, MARGIN_MM, 0.0, 0.0]
    np.testing.assert_allclose(moved, black_rectangles_mm(BOARD), atol=1e-3)
    # 2 px per mm, each the mean of 16: a tenth of a millimetre is a fifth of a pixel.
    printed = cv2.resize(rasterised(rectangles, page_mm, 8), None, fx=0.25, fy=0.25, interpolation=cv2.INTER_AREA)
    found = CharucoDetector(BOARD).detect(printed)
    assert len(found) == len(BOARD.corners_m)
    np.testing.assert_allclose(found.xy_px / 2.0 - [13.0, MARGIN_MM], 1000.0 * BOARD.corners_m[found.ids, :2], atol=0.1)


def test_the_ruler_is_100_mm_and_the_text_says_what_it_is(tmp_path: Path) -> None:
    write_board_pdf(tmp_path / "board.pdf", SIMPLE, "letter")
    pdf = (tmp_path / "board.pdf").read_bytes()
    x, y, x_end, y_end = (float(each) for each in re.search(rb"([\d.]+) ([\d.]+) m ([\d.]+) ([\d.]+) l", pdf).groups())  # type: ignore[union-attr]
    assert y == y_end and (x_end - x) / POINTS_PER_MM == pytest.approx(100.0, abs=1e-3)
    assert b"DICT_4X4_50: 5x4 squares of 24 mm, markers of 18 mm" in pdf and b"must be 100 mm long" in pdf


def test_paper_is_turned_chosen_or_refused() -> None:
    wide = CharucoBoard((CharucoGrid((9, 4), 30.0, 22.0),))
    assert (page_for(wide, "A4").width_mm, page_for(wide, "A4").height_mm) == (297.0, 210.0)
    large = CharucoBoard((CharucoGrid((8, 6), 60.0, 45.0),))
    refused("480x360 mm, but a3 has room for 277x378 or 400x255 mm", page_for, large, "a3")
    assert page_for(large, "board").holds(large.size_mm)
    refused("expected a paper of a4, a3, letter", page_for, large, "a5")


def test_a_board_that_was_printed_is_not_replaced(tmp_path: Path) -> None:
    write_board_pdf(tmp_path / "board.pdf", SIMPLE)
    refused("exists already", write_board_pdf, tmp_path / "board.pdf", BOARD)
    write_board_pdf(tmp_path / "board.pdf", BOARD, overwrite=True)


def test_the_marker_needed_follows_from_the_thin_lens() -> None:
    """50 mm f/4 focused at 1 m: the image lies 1000/19 mm behind the lens, and a point at 0.8 m has a circle of 12.5 mm *
    (1000/19) * (1.25 - 1) / 1000 = 0.1645 mm, 5.848 px of 1280 on 36 mm. A millimetre there spans 1280/36 * (1000/19) / 800 px."""
    view = BoardView(Lens(50.0, 4.0, 1.0, 36.0), 0.8, 1.0, 1280, elevation_deg=30.0)
    px_per_mm = 1280.0 / 36.0 * (1000.0 / 19.0) / 800.0
    assert view.px_per_mm(0.8) == pytest.approx(px_per_mm)
    assert view.needed_marker_mm(0.8) == pytest.approx(6.0 * 5.8480 / px_per_mm / 0.5, rel=1e-4)
    assert view.needed_marker_mm(1.0) == pytest.approx(24.0 / (px_per_mm * 0.8) / 0.5)


def corners_read(board: CharucoBoard, lens: Lens, distance_m: float) -> int:
    sheet = Sheet(black_rectangles_mm(board))
    middle = sheet.middle_m
    pose = HandHeld((float(middle[0]), float(middle[1]), 0.0), distance_m, 45.0, 0.0, 0.0, 0.0, 0.0).camera_from_world(0.0)
    focal_px = lens.focal_px(640)
    rgb = trace_sheet(pack_table(sheet), Camera(640, 360, (focal_px, focal_px), (320.0, 180.0), pose), lens, 12)
    return len(CharucoDetector(board).detect(cv2.cvtColor(display_rgb8(rgb), cv2.COLOR_RGB2GRAY)))


def test_the_planned_board_is_read_at_both_ends_and_smaller_markers_are_not() -> None:
    """The rule is put to the test where it matters: traced through the lens it was planned for. At 4 blurs nothing is read."""
    lens = Lens(22.0, 2.8, 0.9, 24.0)
    view = BoardView(lens, 0.5, 0.9, 640)
    plan = plan_board(view)
    assert plan.board is not None and plan.paper is not None
    assert page_for(plan.board, plan.paper).holds(plan.board.size_mm)
    assert min(corners_read(plan.board, lens, distance_m) for distance_m in (0.5, 0.9)) >= 6
    marker_mm = view.needed_marker_mm(0.5) * 4.0 / 6.0
    assert abs(float(lens.coc_px(0.5, 640))) * 6.0 > 24.0
    assert corners_read(CharucoBoard((CharucoGrid((6, 5), marker_mm / 0.75, marker_mm),)), lens, 0.5) < 6


def test_two_scales_where_sharpness_varies_and_a_larger_paper_where_needed() -> None:
    plan = plan_board(BoardView(Lens(28.0, 4.0, 0.7, 24.0), 0.5, 1.2, 1280))
    assert plan.paper == "a3" and plan.board is not None and len(plan.board.grids) == 2
    assert plan.board.grids[0].marker_mm >= plan.marker_mm and "which a4 cannot hold" in plan.sentence


def test_where_no_paper_helps_the_plan_says_so() -> None:
    plan = plan_board(BoardView(Lens(50.0, 1.8, 0.8, 36.0), 0.5, 1.2, 1280))
    assert plan.board is None and "phone on the camera" in plan.sentence
    refused("nearest <= farthest", BoardView, Lens(50.0, 1.8, 0.8, 36.0), 1.5, 1.2, 1280)


@pytest.mark.parametrize(
    ("view", "corners"),
    [
        # With 3 rows of 57 mm squares, as it was, 6 corners would be left where the blur is strongest.
        pytest.param(BoardView(Lens(28.0, 4.0, 0.7, 24.0), 0.5, 1.2, 1280), 9, id="two scales"),
        pytest.param(BoardView(Lens(22.0, 8.0, 0.7, 24.0), 0.5, 2.0, 1280), 8, id="one scale"),
    ],
)
def test_a_planned_board_keeps_enough_corners_to_calibrate_by(view: BoardView, corners: int) -> None:
    plan = plan_board(view)
    assert plan.board is not None and np.bincount(plan.board.grid_of_corner)[0] == corners and "--calibrate" not in plan.sentence
    # What is read of it where the blur is strongest.
    coarse = CharucoBoard(plan.board.grids[:1])
    found = calibrated(coarse, tilted_views(coarse, np.linspace(-40.0, 40.0, 24), 0.6), 640, 360)
    assert found.camera.focal_px[0] == pytest.approx(600.0, rel=0.02)


def test_a_planned_board_with_too_few_corners_to_calibrate_by_says_so() -> None:
    plan = plan_board(BoardView(Lens(22.0, 5.6, 0.7, 24.0), 0.5, 2.0, 1280))
    assert plan.board is not None and len(plan.board.corners_m) == 6
    assert plan.sentence.endswith("its 6 corners are too few for `mrbokeh track clip --calibrate` (8): give it --camera")
    refused("only 0 frames show 8 corners", calibrated, plan.board, tilted_views(plan.board, np.linspace(-40.0, 40.0, 24), 0.6), 640, 360)
