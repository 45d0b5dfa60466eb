"""Radial distortion against OpenCV, and sparse models as files."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.poses.sparse_model import SparseModel, SparseView, distorted_px, read_sparse_model, undistorted_px, write_sparse_model
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError

CAMERA = Camera(640, 480, (700.0, 705.0), (323.0, 238.5))


@pytest.mark.parametrize("distortion", [(-0.12, 0.03), (0.08, -0.02), (0.05, 0.0), (0.0, 0.0)])
def test_distortion_is_that_of_opencv(distortion: tuple[float, float]) -> None:
    """Brown and Conrady's model is OpenCV's; its pixel (0, 0) has its centre at (0, 0), ours at (0.5, 0.5)."""
    rng = np.random.default_rng(0)
    points = rng.uniform((-0.4, -0.3, 1.0), (0.4, 0.3, 1.0), (50, 3))
    intrinsics = np.array([[700.0, 0, 322.5], [0, 705.0, 238.0], [0, 0, 1]])
    expected, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), intrinsics, np.array([*distortion, 0.0, 0.0]))
    view = SparseView("a", CAMERA, distortion)
    xy_px, depth = view.project(points)
    np.testing.assert_allclose(xy_px, expected.reshape(-1, 2) + 0.5, atol=1e-9)
    np.testing.assert_allclose(view.unproject(xy_px, depth), points, atol=1e-9)


def test_distortion_has_an_inverse_up_to_its_fold() -> None:
    """r (1 - 0.3 r^2) grows until r = 1 / sqrt(0.9) = 1.054, where it is 0.7027; no point is seen beyond."""
    camera = Camera(100, 100, (100.0, 100.0), (50.0, 50.0))
    radius = np.array([0.0, 0.3, 0.9, 1.04])
    xy_px = np.stack([50.0 + 100.0 * radius, np.full(4, 50.0)], axis=-1)
    np.testing.assert_allclose(undistorted_px(camera, (-0.3, 0.0), distorted_px(camera, (-0.3, 0.0), xy_px)), xy_px, atol=1e-4)
    assert np.isnan(undistorted_px(camera, (-0.3, 0.0), np.array([[50.0 + 71.0, 50.0]]))).all()


def small_model() -> SparseModel:
    pose = np.eye(4)
    pose[:3, 3] = -1.0, 0.0, 0.5
    views = (SparseView("a", CAMERA, (0.1, 0.0)), SparseView("b", replace(CAMERA, camera_from_world=pose)))
    points = np.array([[0.0, 0.0, 4.0], [1.0, 0.5, 6.0], [0.2, -0.1, 5.0]])
    observations = np.array([[0, 0], [1, 2], [0, 2], [1, 1]])
    xy_px = np.array([views[v].project(points[p])[0] for v, p in observations])
    return SparseModel(views, points, np.array([0.1, 0.2, 0.3]), observations, xy_px, None, ("c",))


def test_depths_of_the_points_that_a_view_observes() -> None:
    model = small_model()
    xy_px, depth = model.depths_in("b")
    np.testing.assert_allclose(depth, [5.5, 6.5], err_msg="z + 0.5 of points 2 and 1")
    np.testing.assert_allclose(xy_px, model.view("b").project(model.points[[2, 1]])[0])
    np.testing.assert_allclose(model.views[1].centre, [1.0, 0.0, -0.5])


def test_a_scaled_model_looks_the_same() -> None:
    model = replace(small_model(), metres_per_unit=0.25)
    metric = model.scaled()
    np.testing.assert_allclose(metric.depths_in("b")[1], [1.375, 1.625])
    for before, after in zip(model.views, metric.views, strict=True):
        np.testing.assert_allclose(after.project(metric.points)[0], before.project(model.points)[0])
    assert metric.scaled().metres_per_unit == 1.0
    with pytest.raises(InputError, match="capture scale"):
        small_model().scaled()


def test_unknown_and_left_out_views_are_told_apart() -> None:
    with pytest.raises(InputError, match=r"left out.*choose one of a, b"):
        small_model().view("c")
    with pytest.raises(InputError, match="got 'd':"):
        small_model().view("d")


def test_sparse_models_survive_the_disk(tmp_path: Path) -> None:
    model = small_model()
    write_sparse_model(tmp_path, model)
    read = read_sparse_model(tmp_path)
    assert read.left_out == ("c",) and read.metres_per_unit is None
    for name in ("points", "errors_px", "observations", "observed_xy_px"):
        np.testing.assert_array_equal(getattr(read, name), getattr(model, name))
    for before, after in zip(model.views, read.views, strict=True):
        assert after.name == before.name and after.distortion == before.distortion
        np.testing.assert_array_equal(after.camera.camera_from_world, before.camera.camera_from_world)


def test_the_scale_is_read_with_the_model_and_goes_with_it(tmp_path: Path) -> None:
    write_sparse_model(tmp_path, small_model())
    (tmp_path / "scale.json").write_text(json.dumps({"metres_per_unit": 0.5}))
    assert read_sparse_model(tmp_path).metres_per_unit == 0.5
    write_sparse_model(tmp_path, small_model())
    assert read_sparse_model(tmp_path).metres_per_unit is None, "another model has another unit"


def test_broken_models_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="capture poses"):
        read_sparse_model(tmp_path)
    write_sparse_model(tmp_path, small_model())
    whole = (tmp_path / "points.npz").read_bytes()
    (tmp_path / "points.npz").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(InputError, match=r"points\.npz"):
        read_sparse_model(tmp_path)
    with pytest.raises(InputError, match="2 views and 3 points"):
        replace(small_model(), observations=np.array([[0, 3]]), observed_xy_px=np.zeros((1, 2)))
    (tmp_path / "poses.json").write_text("{}")
    with pytest.raises(InputError, match="expected format"):
        read_sparse_model(tmp_path)
