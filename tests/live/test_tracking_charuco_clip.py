"""The traced clip itself: geometry, blur and print are those of the formulas; and the whole print laid over its pictures."""

from dataclasses import replace
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from datasets_scripts.charuco_clip import (
    BoardClip,
    HandHeld,
    Sheet,
    pack_table,
    read_clip_cameras,
    read_sheet,
    trace_sheet,
    with_noise,
    write_clip,
)
from datasets_scripts.tracers._sheet_numba import is_black
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.charuco.board import black_rectangles_mm, write_board
from mrbokeh.tracking.charuco.board_alignment import AlignedDetector, aligned_corners
from mrbokeh.tracking.charuco.detector import CharucoDetector, Corners
from mrbokeh.video.clip import read_frames
from tests.scenes.told_parts import ImmediateDetections
from tests.scenes.traced_board_clip import BOARD, LENS, camera_frames, clip_of, grey_of, pose_error, small_clip
from viewfinder.frames import CameraFrame
from viewfinder.tracking.charuco_tracker import CharucoTracker

ONE_EDGE = Sheet(np.array([[0.0, -500.0, 500.0, 1000.0]]), margin_mm=600.0, paper=1.0, ink=0.0)
"""Black to the right of x = 0, white to the left."""


def above(height_m: float, x_m: float = 0.0, width_px: int = 64) -> Camera:
    """Looks straight down; the point below it is in the middle, which lies on the border of two pixels."""
    pose = np.eye(4)
    pose[:3, 3] = -x_m, 0.0, height_m
    return Camera(width_px, 4, (100.0, 100.0), (width_px / 2, 2.0), pose)


def test_looking_up_a_point_agrees_with_going_through_all_rectangles() -> None:
    rectangles = black_rectangles_mm(BOARD)
    table = pack_table(Sheet(rectangles))
    points_mm = np.random.default_rng(0).uniform(-5.0, 250.0, (4000, 2))
    inside = (points_mm[:, None] >= rectangles[:, :2]) & (points_mm[:, None] < rectangles[:, :2] + rectangles[:, 2:])
    found = [is_black(table, x / 1000.0, y / 1000.0) for x, y in points_mm]
    np.testing.assert_array_equal(found, inside.all(axis=2).any(axis=1))


def test_a_pixel_is_the_area_of_white_in_it() -> None:
    """The edge lies 0.3 px right of the middle: at 1 m and 100 px focal length, 3 mm. Half a million rays: 1 in 700."""
    rgb = trace_sheet(pack_table(ONE_EDGE), above(1.0, x_m=-0.003), None, 4096)
    profile = rgb[:, :, 0].mean(axis=0)
    np.testing.assert_allclose(profile[31:34], (1.0, 0.3, 0.0), atol=0.01)


def test_the_blur_of_an_edge_is_that_of_the_lens() -> None:
    """Across an edge blurred by a disc of diameter c, brightness falls from 1 to 0 with a standard deviation of c / 4 (plus a pixel's)."""
    lens = Lens(50.0, 2.0, 1.0, 1.2)
    height_m = 0.7
    focal_px = lens.focal_px(64)
    camera = Camera(64, 4, (focal_px, focal_px), (32.0, 2.0), above(height_m).camera_from_world)
    profile = trace_sheet(pack_table(ONE_EDGE), camera, lens, 2048)[:, :, 0].mean(axis=0)
    spread = -np.diff(profile)
    places = np.arange(1, 64) - 32.0
    variance = (spread * places**2).sum() - (spread * places).sum() ** 2
    coc_px = float(lens.coc_px(height_m, 64))
    assert coc_px == pytest.approx(-25.0 * (1000.0 / 19.0) * (1.0 / 0.7 - 1.0) / 1000.0 * 64.0 / 1.2)
    assert np.sqrt(variance - 1 / 12) == pytest.approx(abs(coc_px) / 4.0, rel=0.01)


def test_in_focus_the_edge_is_sharp_and_stays_where_it_is_out_of_focus() -> None:
    sharp = Lens(50.0, 2.0, 0.7, 1.2)
    focal_px = sharp.focal_px(64)
    camera = Camera(64, 4, (focal_px, focal_px), (32.0, 2.0), above(0.7).camera_from_world)
    profiles = [trace_sheet(pack_table(ONE_EDGE), camera, lens, 1024)[:, :, 0].mean(axis=0) for lens in (sharp, sharp.focused_at(0.8))]
    np.testing.assert_allclose(profiles[0], np.arange(64) < 32, atol=1e-6)
    np.testing.assert_allclose(profiles[1] + profiles[1][::-1], 1.0, atol=0.02)
    assert 0.5 < profiles[1][31] < 0.6


def test_noise_grows_with_the_root_of_light() -> None:
    rng = np.random.default_rng(0)
    for light in (0.04, 0.64):
        noisy = with_noise(np.full((100, 100, 3), light, np.float32), 0.02, rng)
        assert noisy.std() == pytest.approx(0.02 * np.sqrt(light + 0.01), rel=0.03)


def test_the_hand_looks_at_the_target_from_where_it_was_told() -> None:
    still = HandHeld((0.1, 0.2, 0.0), 0.5, 30.0, 0.0, 0.0, 0.0, 0.0)
    pose = still.camera_from_world(0.4)
    np.testing.assert_allclose(pose @ (0.1, 0.2, 0.0, 1.0), (0.0, 0.0, 0.5, 1.0), atol=1e-12)
    np.testing.assert_allclose(np.linalg.inv(pose)[:3, 3], (0.1, 0.2 + 0.5 * np.cos(np.pi / 6), -0.25), atol=1e-12)


def test_the_hand_moves_smoothly_and_alike_with_one_seed() -> None:
    """Sines: a step of 1/300 s is small against one of 1/3 s."""
    motion = HandHeld((0.1, 0.2, 0.0), seed=3)
    poses = [motion.camera_from_world(time_s) for time_s in (0.0, 1 / 300, 1 / 3)]
    steps = [np.abs(np.linalg.inv(pose)[:3, 3] - np.linalg.inv(poses[0])[:3, 3]).max() for pose in poses]
    assert 0.0 < steps[1] < 0.002 and steps[2] > 5 * steps[1]
    np.testing.assert_array_equal(HandHeld((0.1, 0.2, 0.0), seed=3).camera_from_world(1 / 3), poses[2])
    assert not np.allclose(HandHeld((0.1, 0.2, 0.0), seed=4).camera_from_world(1 / 3), poses[2])


def test_a_clip_is_written_with_its_cameras_and_kept(tmp_path: Path) -> None:
    write_board(tmp_path / "board.json", BOARD)
    sheet = read_sheet(tmp_path / "board.json")
    np.testing.assert_allclose(sheet.black_mm, black_rectangles_mm(BOARD), atol=1e-6)
    clip = BoardClip(sheet, HandHeld((0.092, 0.12, 0.0)), Lens(22.0, 8.0, 0.6, 24.0), 64, 36, 3, samples=2)
    write_clip(tmp_path / "clip.mkv", clip)
    cameras = read_clip_cameras(tmp_path / "clip.json")
    for number, (frame, rgb) in enumerate(zip(read_frames(tmp_path / "clip.mkv"), clip.pictures(), strict=True)):
        np.testing.assert_allclose(frame.rgb, np.clip(rgb, 0.0, 1.0), atol=2e-3)
        np.testing.assert_allclose(cameras[number].camera_from_world, clip.camera(number).camera_from_world)
    assert len(cameras) == 3
    with pytest.raises(InputError, match="exists already"):
        write_clip(tmp_path / "clip.mkv", clip)


def test_a_file_without_rectangles_is_refused(tmp_path: Path) -> None:
    (tmp_path / "board.json").write_text('{"grids": []}')
    with pytest.raises(InputError, match="expected black_mm"):
        read_sheet(tmp_path / "board.json")


@cache
def out_of_focus() -> tuple[CameraFrame, Camera]:
    """f/1.4 focused behind the board: circles of 6 px, in which only the coarse markers are read."""
    return next(camera_frames(clip_of(1024, 576, 1, replace(LENS, f_number=1.4, focus_distance_m=0.75))))


def off_px(corners: Corners, true: Camera) -> float:
    """RMS."""
    off = corners.xy_px - true.project(BOARD.corners_m[corners.ids])[0]
    return float(np.sqrt((off**2).sum(axis=1).mean()))


def test_out_of_focus_all_corners_are_found_ten_times_as_exactly() -> None:
    """0.35 px for the 6 corners read and 0.05 px for all 38 were measured."""
    frame, true = out_of_focus()
    read = CharucoDetector(BOARD).detect(grey_of(frame))
    aligned = aligned_corners(BOARD, grey_of(frame), read)
    assert aligned is not None and len(read) == 6 and len(aligned) == len(BOARD.corners_m)
    assert off_px(aligned, true) < 0.12 and off_px(aligned, true) < 0.4 * off_px(read, true)


def test_brightness_and_contrast_do_not_move_it() -> None:
    frame, true = small_clip()[0]
    grey = grey_of(frame)
    read = CharucoDetector(BOARD).detect(grey)
    results = [
        aligned_corners(BOARD, each, read)
        for each in (grey, cv2.convertScaleAbs(grey, alpha=0.4), cv2.convertScaleAbs(grey, alpha=1.2, beta=5))
    ]
    assert all(result is not None and off_px(result, true) < 0.1 for result in results)


def test_every_frame_of_the_small_clip_is_tracked_four_times_better_than_asked() -> None:
    """Of 0.3 degrees, 3 mm and 2 px; the worst frames, 3 after a search, were off by 0.051, 0.53 and 0.16."""
    tracker = CharucoTracker(BOARD, ImmediateDetections(AlignedDetector(BOARD), every=4))
    for frame, true in small_clip():
        pose = tracker.track(frame, true)
        assert pose is not None and pose.captured_s == frame.captured_s
        error = pose_error(pose.camera_from_world, true)
        assert error.turn_deg < 0.075 and error.place_mm < 0.75 and error.object_px < 0.5


def test_a_hand_over_the_board_does_not_pull_it() -> None:
    frame, true = small_clip()[0]
    covered = grey_of(frame).copy()
    x, y = true.project(np.array([0.09, 0.06, 0.0]))[0].astype(int)
    covered[y - 60 : y + 40, x - 50 : x + 120] = 150
    read = CharucoDetector(BOARD).detect(covered)
    given = AlignedDetector(BOARD).detect(covered)
    assert len(read) >= 20 and aligned_corners(BOARD, covered, read) is None
    np.testing.assert_array_equal(given.xy_px, read.xy_px)


def test_a_start_that_is_off_by_a_square_is_not_believed() -> None:
    """Each corner of the fine grid is taken for its right neighbour: a homography fits that perfectly."""
    frame, true = small_clip()[0]
    fine = np.flatnonzero(BOARD.grid_of_corner == 1).reshape(4, 8)
    slipped = Corners(fine[:, 1:].ravel(), true.project(BOARD.corners_m[fine[:, :-1].ravel()])[0])
    assert aligned_corners(BOARD, grey_of(frame), slipped) is None


@pytest.mark.parametrize("count", [0, 3])
def test_with_fewer_than_four_corners_there_is_no_start(count: int) -> None:
    frame, true = small_clip()[0]
    ids = np.arange(count)
    assert aligned_corners(BOARD, grey_of(frame), Corners(ids, true.project(BOARD.corners_m[ids])[0])) is None


def test_corners_outside_the_picture_are_not_given() -> None:
    frame, true = small_clip()[0]
    left = int(true.project(np.array([0.1, 0.2, 0.0]))[0][0])
    cut = np.ascontiguousarray(grey_of(frame)[:, :left])
    aligned = aligned_corners(BOARD, cut, CharucoDetector(BOARD).detect(cut))
    assert aligned is None or (len(aligned) < len(BOARD.corners_m) and aligned.xy_px[:, 0].max() < left)
