"""Tracking by a printed board against traced frames whose poses are exact, and on a real, dark, hand-held clip; poses from a plane."""

import time
from dataclasses import replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from threading import enumerate as threads

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid
from mrbokeh.tracking.charuco.detector import CharucoDetector, Corners, FrameHistory, Grey, flow
from mrbokeh.tracking.charuco.pose_branches import PoseBranches, PoseFit
from mrbokeh.tracking.charuco.pose_from_points import poses_from_plane
from mrbokeh.video.clip import read_display_frames
from tests.scenes.told_parts import ImmediateDetections
from tests.scenes.traced_board_clip import BOARD, LENS, camera_frames, clip_of, grey_of, pose_error, small_clip
from viewfinder.frames import CameraFrame
from viewfinder.tracking.charuco_tracker import GRACE_S, CharucoTracker, DetectionThread
from viewfinder.tracking.tracker import TrackedPose


class CountingDetector:
    """Counts its searches."""

    def __init__(self, board: CharucoBoard = BOARD) -> None:
        self._detector, self.searches = CharucoDetector(board), 0

    def detect(self, grey: Grey) -> Corners:
        self.searches += 1
        return self._detector.detect(grey)


def tracked(every: int) -> tuple[list[TrackedPose | None], CountingDetector]:
    """The small clip, searched in every nth frame."""
    detector = CountingDetector()
    tracker = CharucoTracker(BOARD, ImmediateDetections(detector, every))
    return [tracker.track(frame, true) for frame, true in small_clip()], detector


def assert_exact(poses: list[TrackedPose | None]) -> None:
    """The bounds are 0.3 degrees, 3 mm and 2 px; half of that has to hold here, where 0.10, 1.1 and 0.5 were measured."""
    for (frame, true), pose in zip(small_clip(), poses, strict=True):
        assert pose is not None and pose.captured_s == frame.captured_s
        error = pose_error(pose.camera_from_world, true)
        assert error.turn_deg < 0.15 and error.place_mm < 1.5 and error.object_px < 1.0


def test_corners_are_found_without_an_offset() -> None:
    """A slip between conventions of pixels would show as half a pixel."""
    frame, true = small_clip()[0]
    found = CharucoDetector(BOARD).detect(grey_of(frame))
    off_px = found.xy_px - true.project(BOARD.corners_m[found.ids])[0]
    assert len(found) >= 36 and len(set(found.ids)) == len(found)
    assert np.abs(off_px.mean(axis=0)).max() < 0.06
    assert np.sqrt((off_px**2).sum(axis=1).mean()) < 0.25


def test_a_picture_without_a_board_gives_no_corners() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (180, 320), dtype=np.uint8)
    assert len(CharucoDetector(BOARD).detect(noise)) == 0
    assert len(CharucoDetector(BOARD).detect(np.zeros((180, 320), np.uint8))) == 0


def test_poses_are_exact_with_a_search_in_every_frame() -> None:
    poses, detector = tracked(1)
    assert_exact(poses)
    assert detector.searches == 12
    assert all(pose is not None and pose.points >= 36 and pose.residual_px < 0.3 and pose.quality > 0.5 for pose in poses)


def test_flow_bridges_frames_without_a_search() -> None:
    poses, detector = tracked(100)
    assert detector.searches == 1
    assert_exact(poses)


def test_flow_gives_up_points_that_do_not_flow_back() -> None:
    """A grey card covers the left half of the next frame: what was there must not be said to be anywhere."""
    (first, _), (second, true) = small_clip()[:2]
    detected = CharucoDetector(BOARD).detect(grey_of(first))
    covered = grey_of(second)
    now_px = true.project(BOARD.corners_m[detected.ids])[0]
    middle = int(now_px[:, 0].mean())
    covered[:, :middle] = 128
    places, good = flow(grey_of(first), covered, detected.xy_px)
    hidden = now_px[:, 0] < middle - 12
    assert hidden.sum() > 10 and not good[hidden].any()
    open_ = now_px[:, 0] > middle + 12
    assert good[open_].mean() > 0.9
    assert np.linalg.norm(places - now_px, axis=1)[good & open_].max() < 0.8


def test_a_late_detection_is_carried_to_the_newest_frame() -> None:
    history = FrameHistory()
    for frame, _ in small_clip()[:5]:
        history.add(frame.sequence, grey_of(frame))
    detected = CharucoDetector(BOARD).detect(grey_of(small_clip()[1][0]))
    carried = history.carry(detected, 1)
    true = small_clip()[4][1]
    assert carried is not None and len(carried) >= 34
    moved_px = np.linalg.norm(detected.xy_px[0] - true.project(BOARD.corners_m[detected.ids[:1]])[0])
    off_px = np.linalg.norm(carried.xy_px - true.project(BOARD.corners_m[carried.ids])[0], axis=1)
    assert moved_px > 3.0 and np.median(off_px) < 0.3
    assert history.carry(detected, 99) is None


def test_history_starts_anew_with_another_size_or_an_older_number() -> None:
    history = FrameHistory(length=3)
    grey = np.zeros((60, 80), np.uint8)
    assert [history.add(number, grey) for number in (0, 1, 2, 3)] == [False, True, True, True]
    assert history.carry(Corners(np.zeros(0, np.int64), np.zeros((0, 2))), 0) is None
    assert not history.add(4, np.zeros((30, 40), np.uint8)) and not history.add(2, np.zeros((30, 40), np.uint8))


def without_board(frame: CameraFrame, later_s: float, sequence: int) -> CameraFrame:
    return CameraFrame(np.full_like(frame.bgr, 90), frame.captured_s + later_s, sequence)


def test_a_lost_board_is_held_then_gone_and_comes_back() -> None:
    tracker = CharucoTracker(BOARD, ImmediateDetections(CharucoDetector(BOARD)))
    frame, true = small_clip()[0]
    seen = tracker.track(frame, true)
    held = tracker.track(without_board(frame, 0.5 * GRACE_S, 1), true)
    gone = tracker.track(without_board(frame, 1.1 * GRACE_S, 2), true)
    back = tracker.track(replace(frame, captured_s=frame.captured_s + 1.0, sequence=3), true)
    assert seen is not None and held is not None and back is not None and gone is None
    assert held.captured_s == seen.captured_s and held.quality == pytest.approx(0.5 * seen.quality)
    assert pose_error(back.camera_from_world, true).place_mm < 1.5 and back.captured_s == frame.captured_s + 1.0


def test_half_a_board_is_enough_and_its_quality_is_lower() -> None:
    frame, true = small_clip()[0]
    whole = CharucoTracker(BOARD, ImmediateDetections(CharucoDetector(BOARD))).track(frame, true)
    covered = frame.bgr.copy()
    covered[: int(true.project(np.array([0.1, 0.135, 0.0]))[0][1])] = (120, 130, 150)
    half = CharucoTracker(BOARD, ImmediateDetections(CharucoDetector(BOARD))).track(replace(frame, bgr=covered), true)
    assert whole is not None and half is not None
    error = pose_error(half.camera_from_world, true)
    assert half.points <= 32 and half.quality < whole.quality and error.turn_deg < 0.5 and error.place_mm < 5.0


def test_the_size_of_the_stream_may_change() -> None:
    """Browsers lower the resolution of a camera under way; the intrinsics follow."""
    tracker = CharucoTracker(BOARD, ImmediateDetections(CharucoDetector(BOARD), every=100))
    (first, true), (second, true_second) = small_clip()[:2]
    assert tracker.track(first, true) is not None
    smaller = replace(second, bgr=cv2.resize(second.bgr, (480, 270), interpolation=cv2.INTER_AREA))
    pose = tracker.track(smaller, true_second.resized(480, 270))
    assert pose is not None and pose.captured_s == second.captured_s
    assert pose_error(pose.camera_from_world, true_second).place_mm < 3.0


def test_the_coarse_grid_survives_defocus_that_the_fine_one_does_not() -> None:
    """f/1.4 focused behind the board: circles of 6 px, markers of 47 and 21 px (1/8 and 1/3.5 of them)."""
    lens = replace(LENS, f_number=1.4, focus_distance_m=0.75)
    frame, true = next(camera_frames(clip_of(1024, 576, 1, lens)))
    middle_m = float(true.project(BOARD.corners_m.mean(axis=0))[1])
    assert 4.5 < abs(float(lens.coc_px(middle_m, 1024))) < 9.0
    found = CharucoDetector(BOARD).detect(grey_of(frame))
    read = np.bincount(BOARD.grid_of_corner[found.ids], minlength=2)
    assert read[0] == 6 and read[1] < 6
    pose = CharucoTracker(BOARD, ImmediateDetections(CharucoDetector(BOARD))).track(frame, true)
    assert pose is not None and pose.quality < 0.3
    error = pose_error(pose.camera_from_world, true)
    assert error.turn_deg < 0.5 and error.place_mm < 6.0


def wait_for_search(tracker: CharucoTracker, frames: list[tuple[CameraFrame, Camera]]) -> TrackedPose | None:
    """Frames in the rhythm of a slow camera until one is tracked."""
    for frame, true in frames:
        pose = tracker.track(frame, true)
        if pose is not None:
            return pose
        time.sleep(0.02)
    return None


def test_searches_run_in_a_thread_that_ends() -> None:
    frame, true = small_clip()[0]
    again = [(replace(frame, captured_s=0.03 * number, sequence=number), true) for number in range(500)]
    tracker = CharucoTracker(BOARD)
    assert "board detection" in {thread.name for thread in threads()}
    pose = wait_for_search(tracker, again)
    tracker.close()
    assert pose is not None and pose_error(pose.camera_from_world, true).place_mm < 1.5
    assert "board detection" not in {thread.name for thread in threads()}


def test_a_failing_search_does_not_end_the_thread(caplog: pytest.LogCaptureFixture) -> None:
    class FailsFirst(CountingDetector):
        def detect(self, grey: Grey) -> Corners:
            if self.searches == 0:
                self.searches = 1
                raise RuntimeError("odd picture")
            return super().detect(grey)

    frame, true = small_clip()[0]
    tracker = CharucoTracker(BOARD, DetectionThread(FailsFirst(), every_s=0.0))
    pose = wait_for_search(tracker, [(replace(frame, captured_s=0.03 * number, sequence=number), true) for number in range(500)])
    tracker.close()
    assert pose is not None and "searching a frame for the board failed" in caplog.text


@cache
def dark_clip(path: Path) -> list[np.ndarray]:
    return [frame.bgr for frame in read_display_frames(path, 320, 180)]


def test_a_real_dark_clip_is_tracked_in_most_frames(shared_data: Path) -> None:
    """320x180, mean code 14, glare on a tablet in the last third. OpenCV alone finds 6 corners in 77 % of the frames.

    Its intrinsics are not known: 300 px fit best; its scale neither, which changes nothing in pixels.
    """
    path = shared_data / "video" / "charuco_handheld.mp4"
    if not path.is_file():
        pytest.skip("video/charuco_handheld.mp4 is not in the shared test data")
    board = CharucoBoard((CharucoGrid((5, 5), 28.8, 21.6),))
    tracker = CharucoTracker(board, ImmediateDetections(CharucoDetector(board), every=6))
    camera = Camera(320, 180, (300.0, 300.0), (160.0, 90.0))
    poses = [tracker.track(CameraFrame(bgr, number / 60.0, number), camera) for number, bgr in enumerate(dark_clip(path))]
    fresh = [pose for number, pose in enumerate(poses) if pose is not None and pose.captured_s == number / 60.0]
    assert len(poses) == 443 and len(fresh) > 0.82 * len(poses)
    assert np.mean([pose.residual_px for pose in fresh]) < 0.4
    steps = [np.linalg.norm(one.camera_from_world[:3, 3] - other.camera_from_world[:3, 3]) for one, other in pairwise(fresh)]
    assert np.median(steps) < 0.01, "poses jump about"


CAMERA = Camera(640, 360, (590.0, 590.0), (320.0, 180.0))


def pose_from_plane(points_m: np.ndarray, xy_px: np.ndarray, camera: Camera) -> PoseFit | None:
    """The likelier pose of a single picture."""
    found = poses_from_plane(points_m, xy_px, camera)
    return None if found is None else PoseBranches().take(found, 0.0)


def pose_of(turn_deg: tuple[float, float, float], place_m: tuple[float, float, float]) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", turn_deg, degrees=True).as_matrix()
    pose[:3, 3] = place_m
    return pose


def seen_px(pose: np.ndarray, noise_px: float = 0.0, seed: int = 0) -> np.ndarray:
    exact = replace(CAMERA, camera_from_world=pose).project(BOARD.corners_m)[0]
    return exact + np.random.default_rng(seed).normal(0.0, noise_px, exact.shape)


def test_perfect_points_give_the_exact_pose_and_outliers_do_not_matter() -> None:
    pose = pose_of((35.0, -20.0, 10.0), (-0.08, -0.1, 0.6))
    xy_px = seen_px(pose)
    xy_px[::6] += np.random.default_rng(1).uniform(10.0, 40.0, xy_px[::6].shape)
    fit = pose_from_plane(BOARD.corners_m, xy_px, CAMERA)
    assert fit is not None and not fit.inliers[::6].any() and fit.inliers.sum() == len(xy_px) - len(xy_px[::6])
    np.testing.assert_allclose(fit.camera_from_world, pose, atol=1e-5)
    assert fit.residual_px < 1e-3


def test_the_residual_is_that_of_the_noise() -> None:
    """0.2 px in x and y: RMS distance 0.2 sqrt(2), less what 6 parameters take of 76 numbers."""
    fits = [
        pose_from_plane(BOARD.corners_m, seen_px(pose_of((35.0, 0.0, 0.0), (-0.08, -0.1, 0.6)), 0.2, seed), CAMERA) for seed in range(10)
    ]
    residuals = [fit.residual_px for fit in fits if fit is not None]
    assert np.mean(residuals) == pytest.approx(0.2 * np.sqrt(2.0) * np.sqrt(70 / 76), rel=0.05)


def test_too_few_points_points_on_a_line_and_nonsense_give_no_pose() -> None:
    xy_px = seen_px(pose_of((35.0, 0.0, 0.0), (-0.08, -0.1, 0.6)))
    assert pose_from_plane(BOARD.corners_m[:5], xy_px[:5], CAMERA) is None
    row = np.flatnonzero(np.isclose(BOARD.corners_m[:, 1], 0.163))
    assert len(row) == 8 and pose_from_plane(BOARD.corners_m[row], xy_px[row], CAMERA) is None
    anywhere = np.random.default_rng(0).uniform(0, 360, xy_px.shape)
    assert pose_from_plane(BOARD.corners_m, anywhere, CAMERA) is None
