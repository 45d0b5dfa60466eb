"""The pose from points of a plane: exact without noise, deaf to outliers, silent where there is none."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.charuco.pose_branches import PoseBranches, PoseFit
from mrbokeh.tracking.charuco.pose_from_points import poses_from_plane
from tests.scenes.traced_board_clip import BOARD

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
