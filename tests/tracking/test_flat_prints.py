"""Chessboards, tags and pictures: prints warped into frames by true cameras, so that every pose is known."""

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_scripts.charuco_clip import HandHeld
from mrbokeh.commands.track import app
from mrbokeh.images.image_io import write_preview
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.board_track import track_board
from mrbokeh.tracking.charuco.board import CharucoBoard
from mrbokeh.tracking.charuco.flat_prints import Chessboard, FlatPicture, FlatPrint, TagGrid, finder_of, read_picture, read_print
from tests.support.command_line import printed_by
from tests.support.refusals import refused
from tests.support.textured_room import PAPERS
from tests.support.traced_board_clip import MOTION
from tests.support.video_files import filmed

SIZE_PX, FOCAL_PX, FRAMES, HIDDEN = (480, 360), 460.0, 8, (4, 5)
WIDTH_M = 0.24


def chessboard() -> tuple[FlatPrint, np.ndarray]:
    board = Chessboard((8, 6), 30.0)
    squares = (np.indices(board.squares[::-1]).sum(axis=0) % 2 * 255).astype(np.uint8)
    return board, np.kron(squares, np.ones((40, 40), np.uint8))


def tags() -> tuple[FlatPrint, np.ndarray]:
    board = TagGrid((4, 3), 48.0, 16.0, first_marker=5)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_APRILTAG_36h11)
    drawn = np.full((3 * 128 - 32, 4 * 128 - 32), 255, np.uint8)
    for number in range(12):
        row, column = divmod(number, 4)
        drawn[128 * row : 128 * row + 96, 128 * column : 128 * column + 96] = cv2.aruco.generateImageMarker(dictionary, 5 + number, 96)
    return board, drawn


def poster() -> tuple[FlatPrint, np.ndarray]:
    drawn = np.ascontiguousarray(cv2.GaussianBlur(PAPERS[0], (0, 0), 1.5)[:384, :512])
    return FlatPicture(drawn, WIDTH_M), drawn


PRINTS = {"chessboard": chessboard, "tags": tags, "poster": poster}


def camera(number: int) -> Camera:
    """A hand before the middle of the print, of which it sees all, obliquely."""
    hand: HandHeld = MOTION
    pose = hand.camera_from_world(number / 15.0)
    middle = np.eye(4)
    middle[:2, 3] = -0.12, -0.09
    seen = pose @ middle
    ahead = np.eye(4)
    ahead[:3, 3] = np.array([0.0, 0.0, 0.45]) - (pose @ [0.0, 0.0, 0.0, 1.0])[:3] * [1.0, 1.0, 1.0]
    return Camera(*SIZE_PX, (FOCAL_PX, FOCAL_PX), (SIZE_PX[0] / 2, SIZE_PX[1] / 2), ahead @ seen)


def frame(printed: FlatPrint, drawn: np.ndarray, number: int, exposure: float = 1.0) -> np.ndarray:
    """The print on a grey table; grey codes of 8 bits."""
    view, (width_m, _) = camera(number), (side / 1000.0 for side in printed.size_mm)
    lens = np.array([[FOCAL_PX, 0.0, SIZE_PX[0] / 2], [0.0, FOCAL_PX, SIZE_PX[1] / 2], [0.0, 0.0, 1.0]])
    metres = np.diag([width_m / drawn.shape[1], width_m / drawn.shape[1], 1.0])
    half = np.array([[1.0, 0.0, 0.5], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0]])
    through = np.linalg.inv(half) @ lens @ view.camera_from_world[:3, [0, 1, 3]] @ metres @ half
    margin = 40
    sheet = cv2.copyMakeBorder(drawn, margin, margin, margin, margin, cv2.BORDER_CONSTANT, value=255)
    shift = np.array([[1.0, 0.0, -margin], [0.0, 1.0, -margin], [0.0, 0.0, 1.0]])
    # Drawn four times as fine and made smaller: edges are as a sensor sees them.
    fine = np.array([[4.0, 0.0, 1.5], [0.0, 4.0, 1.5], [0.0, 0.0, 1.0]])
    size = (4 * SIZE_PX[0], 4 * SIZE_PX[1])
    seen = cv2.warpPerspective(sheet, fine @ through @ shift, size, flags=cv2.INTER_LINEAR, borderValue=120)
    return np.asarray(cv2.resize(seen, SIZE_PX, interpolation=cv2.INTER_AREA) * exposure).astype(np.uint8)


def off_px(corners_m: np.ndarray, found: Camera, true: Camera) -> float:
    """Worst distance of places on the print, and 5 cm above it, from where the true camera sees them."""
    places = np.concatenate([corners_m, corners_m - [0.0, 0.0, 0.05]])
    return float(np.linalg.norm(found.project(places)[0] - true.project(places)[0], axis=1).max())


@pytest.mark.parametrize("kind", PRINTS)
def test_prints_are_tracked_and_what_is_hidden_is_not(kind: str, tmp_path: Path) -> None:
    """Worst place of each frame to within 1 px (tags: 2), RMS of the corners below 0.4 px; two frames in which it is hidden are
    bridged."""
    make: Callable[[], tuple[FlatPrint, np.ndarray]] = PRINTS[kind]
    printed, drawn = make()
    greys = [np.full(SIZE_PX[::-1], 90, np.uint8) if n in HIDDEN else frame(printed, drawn, n) for n in range(FRAMES)]
    clip = filmed(tmp_path / "clip.mkv", (np.repeat((each[..., None] / 255.0) ** 2.2, 3, axis=2).astype(np.float32) for each in greys), 15)
    tracked = track_board(clip, printed, camera(0))
    assert tracked.bridged == HIDDEN and tracked.seen == FRAMES - len(HIDDEN) and tracked.residual_px < 0.4
    for number in set(range(FRAMES)) - set(HIDDEN):
        assert off_px(printed.corners_m, tracked.track.at(number).camera, camera(number)) < (2.0 if kind == "tags" else 1.0)


def test_a_dim_poster_is_found_where_it_lies() -> None:
    """At a tenth of the light, codes up to 25: single points to half a pixel in the median."""
    printed, drawn = poster()
    found = finder_of(printed).detect(frame(printed, drawn, 3, exposure=0.1))
    seen_px = camera(3).project(printed.corners_m[found.ids])[0]
    assert len(found) > 50 and np.median(np.linalg.norm(found.xy_px - seen_px, axis=1)) < 0.5
    assert len(finder_of(printed).detect(frame(*chessboard(), 3))) == 0


def test_a_chessboard_is_found_the_right_way_round() -> None:
    """8x6 squares look alike after half a turn, so that the first frame decides; 7x6 do not, so that colours do."""
    even, drawn = chessboard()
    finder, upright = finder_of(even), frame(even, drawn, 0)
    first = finder.detect(upright)
    np.testing.assert_allclose(first.xy_px, camera(0).project(even.corners_m)[0], atol=0.4)
    np.testing.assert_allclose(
        finder.detect(np.ascontiguousarray(upright[::-1, ::-1])).xy_px, np.array(SIZE_PX) - first.xy_px[::-1], atol=1.0
    )
    odd = Chessboard((7, 6), 30.0)
    seen = frame(odd, np.ascontiguousarray(drawn[:, : 7 * 40]), 0)
    for picture, back in ((seen, False), (np.ascontiguousarray(seen[::-1, ::-1]), True)):
        places = finder_of(odd).detect(picture).xy_px
        places = np.array(SIZE_PX) - places if back else places
        np.testing.assert_allclose(places, camera(0).project(odd.corners_m)[0], atol=0.4)


def test_board_files_say_what_they_are(tmp_path: Path) -> None:
    texts = {
        "chess.toml": 'kind = "chessboard"\nsquares = [9, 6]\nsquare_mm = 30',
        "tags.json": '{"kind": "tags", "tags": [6, 4], "tag_mm": 24, "gap_mm": 7.2}',
        "charuco.toml": "squares = [8, 6]\nsquare_mm = 30.0\nmarker_mm = 22.0",
    }
    for name, text in texts.items():
        (tmp_path / name).write_text(text)
    read = [read_print(tmp_path / name) for name in texts]
    assert read[:2] == [Chessboard((9, 6), 30.0), TagGrid((6, 4), 24.0, 7.2)] and isinstance(read[2], CharucoBoard)
    assert len(read[1].corners_m) == 96 and read[1].size_mm == pytest.approx((6 * 31.2 - 7.2, 4 * 31.2 - 7.2))
    for text, says in (
        ('kind = "circles"', "chessboard or tags"),
        ('kind = "chessboard"\nsquares = [9, 6]\ntag_mm = 3', "got tag_mm"),
        ('kind = "chessboard"\nsquares = [9]\nsquare_mm = 3', "squares = \\[columns, rows\\]"),
        ('kind = "chessboard"\nsquares = [3, 3]\nsquare_mm = 3', "4x4 squares"),
        ('kind = "tags"\ntags = [6, 4]\ntag_mm = 24\ngap_mm = 7\ndictionary = "X"', "dictionary"),
    ):
        (tmp_path / "bad.toml").write_text(text)
        with pytest.raises(InputError, match=says):
            read_print(tmp_path / "bad.toml")
    write_preview(tmp_path / "even.png", np.full((64, 64, 3), 0.2, np.float32))
    with pytest.raises(InputError, match="more detail"):
        _ = read_picture(tmp_path / "even.png", 0.3).corners_m
    refused("in metres, above 0", read_picture, tmp_path / "even.png", -1.0)
    clip = ("clip", tmp_path / "clip.mp4", "--out", tmp_path / "track.json", "--calibrate")
    refused("either --board", printed_by, app, *clip)
    refused("go together", printed_by, app, *clip, "--poster", tmp_path / "even.png")
