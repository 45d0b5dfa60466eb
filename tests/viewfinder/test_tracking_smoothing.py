"""The 1-Euro filter on poses, against what was simulated for it: steady at rest, hardly late in a pan; and a camera on a tripod."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera, camera_to_json
from mrbokeh.system.atomic_files import write_json
from tests.support.refusals import refused
from tests.support.told_parts import ToldTracker
from viewfinder.frames import CameraFrame
from viewfinder.tracking.smoothing import OneEuroPose, SmoothedTracker
from viewfinder.tracking.tracker import TrackedPose, read_fixed_pose

FPS, FOCAL_PX = 30.0, 1000.0


def pose_of(turn_deg: np.ndarray, place_m: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(turn_deg, degrees=True).as_matrix()
    pose[:3, 3] = place_m
    return pose


def panned(yaw_deg: float) -> np.ndarray:
    """A camera that turns on the spot before a board 1 m away."""
    pose = pose_of(np.array([0.0, -yaw_deg, 0.0]), np.zeros(3))
    pose[:3, 3] = pose[:3, :3] @ (0.0, 0.0, 1.0)
    return pose


def x_px(pose: np.ndarray) -> float:
    """Of the board's origin in the picture."""
    return FOCAL_PX * float(pose[0, 3] / pose[2, 3])


def noisy(seed: int, pan_deg_s: float, frames: int, noise_deg: float = 0.05) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [panned(pan_deg_s * (number / FPS - 1.0) + rng.normal(0.0, noise_deg)) for number in range(frames)]


def filtered(poses: list[np.ndarray]) -> list[np.ndarray]:
    smooth = OneEuroPose()
    return [smooth(pose, number / FPS) for number, pose in enumerate(poses)]


def test_at_rest_the_jitter_falls_to_a_fifth() -> None:
    """Noise of 0.05 degrees is 0.87 px at 1000 px, so 1.23 px rms from frame to frame; 0.15 px was simulated on one axis."""
    raw = noisy(0, 0.0, 300)
    before, after = (np.std(np.diff([x_px(pose) for pose in poses[30:]])) for poses in (raw, filtered(raw)))
    assert before == pytest.approx(1.23, rel=0.1) and after < 0.2 * before


def test_in_a_pan_it_lags_by_few_pixels() -> None:
    """20 degrees per second: an exponential average as steady would lag by 40 px, 2.3 px was simulated."""
    exact = noisy(0, 20.0, 60, noise_deg=0.0)
    lag = [x_px(smooth) - x_px(pose) for smooth, pose in zip(filtered(exact), exact, strict=True)]
    assert 0.5 < abs(lag[-1]) < 4.0


def test_its_arithmetic_is_that_of_the_paper() -> None:
    """One step of 1 degree in 1/30 s, by hand: the speed's share is 2 pi / (2 pi + 30), the cutoff 0.5 Hz + that share of 30 deg/s."""
    smooth = OneEuroPose()
    smooth(pose_of(np.zeros(3), np.array([0.0, 0.0, 1.0])), 0.0)
    turned = smooth(pose_of(np.array([1.0, 0.0, 0.0]), np.array([0.0, 0.0, 1.0])), 1.0 / FPS)
    speed = 30.0 * 2.0 * np.pi / (2.0 * np.pi + 30.0)
    rate = 2.0 * np.pi * (0.5 + speed) / FPS
    assert np.rad2deg(np.linalg.norm(Rotation.from_matrix(turned[:3, :3]).as_rotvec())) == pytest.approx(rate / (rate + 1.0))


def test_what_it_gives_is_a_rigid_pose_and_a_resting_one_stays_as_it_is() -> None:
    still = pose_of(np.array([20.0, -35.0, 170.0]), np.array([0.1, -0.2, 0.7]))
    smooth = OneEuroPose(pivot_m=(0.1, 0.12, 0.0))
    given = [smooth(still, number / FPS) for number in range(5)]
    np.testing.assert_allclose(given[-1], still, atol=1e-12)
    moved = smooth(pose_of(np.array([25.0, -30.0, 160.0]), np.array([0.2, -0.2, 0.9])), 0.5)
    np.testing.assert_allclose(moved[:3, :3] @ moved[:3, :3].T, np.eye(3), atol=1e-12)


def test_turning_about_the_board_keeps_the_pivot_still() -> None:
    """Poses that differ by a turn about the pivot: whatever the filter does to the turn, the pivot stays at its pixel."""
    pivot, smooth = np.array([0.1, 0.12, 0.0]), OneEuroPose(pivot_m=(0.1, 0.12, 0.0))
    for number, angle in enumerate(np.linspace(0.0, 15.0, 10)):
        pose = pose_of(np.array([angle, 0.0, 0.0]), np.zeros(3))
        pose[:3, 3] = np.array([0.0, 0.0, 0.8]) - pose[:3, :3] @ pivot
        given = smooth(pose, number / FPS)
        np.testing.assert_allclose(given[:3, :3] @ pivot + given[:3, 3], (0.0, 0.0, 0.8), atol=1e-12)


FRAME = CameraFrame(np.zeros((4, 4, 3), np.uint8), 0.0, 0)
CAMERA = Camera(4, 4, (4.0, 4.0), (2.0, 2.0))


def given(poses: list[TrackedPose | None]) -> ToldTracker:
    left = iter(poses)
    return ToldTracker(lambda _: next(left))


def test_off_is_the_default_and_changes_nothing() -> None:
    poses = [TrackedPose(pose, 0.8, number / FPS) for number, pose in enumerate(noisy(1, 0.0, 4))]
    tracker = SmoothedTracker(given(poses))
    assert tracker.name == "told" and [tracker.track(FRAME, CAMERA) for _ in poses] == poses


def test_after_a_loss_it_begins_anew() -> None:
    first, later = TrackedPose(panned(0.0), 0.8, 0.0), TrackedPose(panned(10.0), 0.8, 0.1)
    inner = given([first, None, later, replace(first, captured_s=0.2)])
    tracker = SmoothedTracker(inner, smoothing=True)
    once, lost, again, back = (tracker.track(FRAME, CAMERA) for _ in range(4))
    assert once is not None and lost is None
    np.testing.assert_allclose(again.camera_from_world, later.camera_from_world, atol=1e-12)
    assert abs(x_px(back.camera_from_world)) > 1.0 and back.quality == 0.8
    tracker.close()
    assert inner.closed


def test_a_pose_that_is_given_again_is_not_filtered_in() -> None:
    """While a lost track is held, the same pose comes with the same time."""
    smooth = OneEuroPose()
    smooth(panned(0.0), 0.0)
    once = smooth(panned(1.0), 0.1)
    np.testing.assert_array_equal(smooth(panned(1.0), 0.1), once)


POSE = np.array([[1.0, 0.0, 0.0, 0.1], [0.0, 0.8, -0.6, 0.2], [0.0, 0.6, 0.8, 0.9], [0.0, 0.0, 0.0, 1.0]])
TRIPOD = Camera(640, 360, (600.0, 600.0), (320.0, 180.0), POSE)


def test_the_pose_of_the_file_is_that_of_every_frame(tmp_path: Path) -> None:
    write_json(tmp_path / "camera.json", camera_to_json(TRIPOD))
    tracker = read_fixed_pose(tmp_path / "camera.json")
    for number in range(2):
        tracked = tracker.track(CameraFrame(np.zeros((9, 16, 3), np.uint8), 0.1 * number, number), TRIPOD)
        assert tracked.captured_s == 0.1 * number and tracked.quality == 1.0
        np.testing.assert_array_equal(tracked.camera_from_world, POSE)
    assert tracker.camera.focal_px == (600.0, 600.0)


def test_files_that_are_no_camera_are_refused(tmp_path: Path) -> None:
    write_json(tmp_path / "list.json", [1, 2])
    skewed = POSE.copy()
    skewed[0, 0] = 2.0
    write_json(tmp_path / "skewed.json", camera_to_json(replace(TRIPOD, camera_from_world=skewed)))
    for name, sentence in (("none", "no such file"), ("list", "expected width_px"), ("skewed", "rigid")):
        refused(sentence, read_fixed_pose, tmp_path / f"{name}.json")


def test_smoothing_does_not_glide_from_a_wrong_pose_to_the_right_one() -> None:
    """An unsure pose is given as it comes, and the next certain one, too."""
    wrong, right = np.eye(4), np.eye(4)
    wrong[:3, 3], right[:3, 3] = (0.0, 0.0, 1.0), (0.1, 0.0, 1.0)
    poses = [wrong, wrong, right]
    inner = ToldTracker(lambda frame: TrackedPose(poses[frame.sequence], 0.2, frame.captured_s, is_certain=frame.sequence == 2))
    smoothed = SmoothedTracker(inner, smoothing=True)
    for number, pose in enumerate(poses):
        shown = smoothed.track(CameraFrame(np.zeros((4, 4, 3), np.uint8), number / 30.0, number), CAMERA)
        np.testing.assert_allclose(shown.camera_from_world, pose, atol=1e-12)
