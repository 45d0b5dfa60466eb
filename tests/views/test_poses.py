"""Poses: what COLMAP is given, how its deaths and failures reach the user, sparse models as files, real pictures without parallax."""

import json
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path

import cv2
import numpy as np
import pytest

from capture.commands import poses
from capture.poses import colmap
from capture.poses.colmap import PoseSettings, find_picture_poses, find_scene_poses, run_colmap
from capture.poses.colmap_job import (
    ColmapJob,
    ColmapPicture,
    camera_model_for,
    common_exposure_stops,
    job_from_json,
    job_to_json,
    picture_cameras,
    pictures_in,
    stack_cameras,
    write_stack_pictures,
)
from capture.poses.colmap_matches import failure_message, median_parallax_deg, weak_model_message
from capture.poses.sparse_model import SparseModel, SparseView, read_sparse_model, write_sparse_model
from mrbokeh.distortion.radial import distorted_px, undistorted_px
from mrbokeh.images.image_io import write_image
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack
from mrbokeh.system.atomic_files import read_json, write_json
from mrbokeh.system.errors import InputError, MissingExtraError
from tests.support.command_line import printed_by
from tests.support.refusals import refused

needs_colmap = pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap (extra `capture`) is not installed")


def stack_in(folder: Path, grey: float = 0.1, focus_m: float | None = 0.6) -> FocalStack:
    lens = None if focus_m is None else Lens(35.0, 2.0, focus_m, 23.5)
    camera = None if lens is None else Camera(64, 48, (lens.focal_px(64),) * 2, (32.0, 24.0))
    write_image(folder / "all_in_focus.exr", np.full((48, 64, 3), grey, np.float32))
    stack = FocalStack(folder, (Slice("00.exr", focus_m),), lens, camera, merged=True)
    write_focal_stack(stack)
    return stack


def test_views_of_one_reference_focus_share_a_camera_calibrated_or_not(tmp_path: Path) -> None:
    """Their focal length in pixels is the same; another focus has another, f d / (d - f)."""
    stacks = [stack_in(tmp_path / name, focus_m=focus) for name, focus in (("a", 0.6), ("b", 0.8), ("c", 0.6))]
    numbers, priors = stack_cameras(stacks, "auto")
    assert numbers == [0, 1, 0]
    assert priors[0] is not None and priors[0] == pytest.approx((35.0 / (1.0 - 0.035 / 0.6) * 64 / 23.5, 32.0, 24.0))
    assert stack_cameras(stacks, "separate")[0] == [0, 1, 2]
    assert stack_cameras(stacks, "shared")[0] == [0, 0, 0]
    unknown = [stack_in(tmp_path / name, focus_m=None) for name in ("d", "e")]
    assert stack_cameras(unknown, "auto") == ([0, 0], [None])
    # Calibration moves the focus of each stack a little; what was stated decides.
    stacks = []
    for name, found_m in (("a", 0.612), ("b", 0.618)):
        stack = stack_in(tmp_path / name, focus_m=0.6)
        moved = Slice("00.exr", found_m, metadata={"stated_focus_distance_m": 0.6})
        stacks.append(replace(stack, slices=(moved,), lens=stack.lens.focused_at(found_m)))
    assert stack_cameras(stacks, "auto")[0] == [0, 0]


def test_pictures_of_one_size_share_a_camera_and_five_of_them_a_second_term(tmp_path: Path) -> None:
    for name, width in (("a", 40), ("b", 40), ("c", 50)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((30, width, 3), np.uint8))
    files = pictures_in(tmp_path)
    assert picture_cameras(files[:2], "auto")[0] == [0, 0]
    assert picture_cameras(files, "auto")[0] == [0, 1, 2]
    refused("pictures of one size", picture_cameras, files, "shared")
    assert camera_model_for([0] * 5, "auto") == "RADIAL"
    assert camera_model_for([0] * 5 + [1], "auto") == "SIMPLE_RADIAL"
    assert camera_model_for([0], "RADIAL") == "RADIAL"


@pytest.mark.parametrize(("asked", "fewest_terms"), [("auto", True), ("SIMPLE_RADIAL", False)])
def test_terms_of_distortion_that_were_asked_for_are_not_left_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, asked: str, fewest_terms: bool
) -> None:
    for name in ("a", "b"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.zeros((30, 40, 3), np.uint8))
    nothing_found = {"pictures": 2, "pairs": 1, "good_pairs": 0, "forward": 0.0, "low_parallax": 0.0}
    monkeypatch.setattr(colmap, "run_colmap", lambda *_: nothing_found)
    refused("0 of 1 pairs", find_picture_poses, tmp_path, tmp_path / "out", PoseSettings(camera_model=asked))
    job = job_from_json(read_json(tmp_path / "out" / "colmap_job.json", "the job"))
    assert (job.camera_model, job.fewest_terms) == ("SIMPLE_RADIAL", fewest_terms)


def test_pictures_of_all_views_have_one_exposure(tmp_path: Path) -> None:
    """Half of the pixels at 0.02 and half at 0.08: the median of all, 0.05, becomes 0.18, by log2(3.6) stops."""
    stacks = [stack_in(tmp_path / "a", 0.02), stack_in(tmp_path / "b", 0.08)]
    assert common_exposure_stops(stacks) == pytest.approx(np.log2(3.6), abs=0.01)
    files = write_stack_pictures(tmp_path, stacks, tmp_path / "images")
    values = [cv2.imread(str(tmp_path / "images" / file))[0, 0, 0] for file in files]
    encoded = [1.055 * (grey * 3.6) ** (1 / 2.4) - 0.055 for grey in (0.02, 0.08)]
    np.testing.assert_allclose(values, 255 * np.array(encoded), atol=1.5)
    bright = [stack_in(tmp_path / "c", 0.9)]
    assert common_exposure_stops(bright) == pytest.approx(np.log2(0.2), abs=0.01)


def test_jobs_survive_json_and_know_what_features_depend_on() -> None:
    job = ColmapJob((ColmapPicture("a", "a.png", "00", 0),), ((100.0, 32.0, 24.0),))
    assert job_from_json(job_to_json(job)) == job
    assert replace(job, mapper="global", threads=2, fewest_terms=False).features_key() == job.features_key()
    assert replace(job, seed=1).features_key() != job.features_key()


def seen_from(positions_m: list[tuple[float, float, float]], points: np.ndarray, left_out: tuple[str, ...] = ()) -> SparseModel:
    views = []
    for index, position in enumerate(positions_m):
        pose = np.eye(4)
        pose[:3, 3] = -np.asarray(position)
        views.append(SparseView(f"v{index}", Camera(640, 480, (500.0, 500.0), (320.0, 240.0), pose)))
    observations = np.array([(view, point) for view in range(len(views)) for point in range(len(points))])
    return SparseModel(tuple(views), points, np.zeros(len(points)), observations, np.zeros((len(observations), 2)), None, left_out)


def test_parallax_and_left_out_pictures_decide_over_a_model() -> None:
    """From 1 to the left and 1 to the right, at a distance of 10, a point is seen under 2 atan 0.1."""
    model = seen_from([(-1.0, 0.0, 0.0), (0.2, 0.0, 0.0), (1.0, 0.0, 0.0)], np.array([[0.0, 0.0, 10.0]] * 3))
    assert median_parallax_deg(model) == pytest.approx(np.degrees(2.0 * np.arctan(0.1)))
    assert weak_model_message(model) is None
    points = np.array([[0.0, 0.0, 100.0]])
    narrow = seen_from([(0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.0, 0.0, 9.0)], points)
    assert "farther sideways" in str(weak_model_message(narrow))
    few = seen_from([(0.0, 0.0, 0.0), (9.0, 0.0, 0.0), (0.0, 9.0, 0.0)], points, ("a", "b", "c"))
    assert "only 3 of 6 pictures (v0, v1, v2)" in str(weak_model_message(few))


@pytest.mark.parametrize(
    ("seen", "message"),
    [
        ({"good_pairs": 3, "forward": 0.0, "low_parallax": 0.0}, "only 3 of 28 pairs"),
        ({"good_pairs": 20, "forward": 0.9, "low_parallax": 0.2}, "90 % move along the line of sight"),
        ({"good_pairs": 20, "forward": 0.0, "low_parallax": 0.1}, "--mapper global"),
    ],
)
def test_failures_say_why_and_what_to_do(seen: dict[str, float], message: str) -> None:
    assert message in failure_message({"pictures": 8, "pairs": 28} | seen)


@needs_colmap
def test_the_death_of_colmap_is_one_sentence(tmp_path: Path) -> None:
    """A file that is no database makes COLMAP's SQLite give up."""
    (tmp_path / "images").mkdir()
    cv2.imwrite(str(tmp_path / "images" / "a.png"), np.zeros((30, 40, 3), np.uint8))
    write_json(tmp_path / "colmap_job.json", job_to_json(ColmapJob((ColmapPicture("a", "a.png", "00", 0),), (None,))))
    (tmp_path / "database.db").write_bytes(b"this is no database" * 100)
    refused(r"COLMAP stopped with .* while finding features .*database", run_colmap, tmp_path, 1)


def test_the_death_of_colmap_and_its_lack_are_one_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "dying_worker.py").write_text('import os\nprint(\'{"stage": "matches", "done": 1, "total": 3}\', flush=True)\nos.abort()\n')
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr(colmap, "_WORKER", "dying_worker")
    monkeypatch.setattr(colmap, "find_spec", lambda name: name)
    refused("COLMAP stopped with SIGABRT while matching", run_colmap, tmp_path, 3)
    monkeypatch.setattr(colmap, "find_spec", {}.get)
    with pytest.raises(MissingExtraError, match=r"pip install .*\[capture\]"):
        run_colmap(tmp_path, 3)


def test_mistakes_are_named_and_finished_poses_kept(tmp_path: Path) -> None:
    stack_in(tmp_path / "scene" / "a")
    refused("one stack: camera poses need at least 2", find_scene_poses, tmp_path / "scene")
    refused("found 0", find_picture_poses, tmp_path, tmp_path / "out")
    refused("there is none", find_picture_poses, tmp_path / "nowhere", tmp_path / "out")
    refused("--mapper must be one of incremental, global", PoseSettings, mapper="sequential")
    refused("either a SCENE", printed_by, poses.poses_command, tmp_path, "--images", tmp_path)
    # Nothing else is in the folder, so anything but reading would fail.
    kept = tmp_path / "kept"
    write_sparse_model(kept / "reconstruction", seen_from([(0.0, 0.0, 0.0)], np.array([[0.0, 0.0, 1.0]])))
    assert find_scene_poses(kept).views[0].name == "v0"
    refused("capture process", find_scene_poses, kept, PoseSettings(overwrite=True))


@needs_colmap
@pytest.mark.slow
@pytest.mark.parametrize(("name", "count"), [("fox", 25), ("sacre_coeur", 10)])
def test_real_pictures_are_all_placed(shared_data: Path, tmp_path: Path, name: str, count: int) -> None:
    model = find_picture_poses(shared_data / "multiview" / name / "images", tmp_path, PoseSettings(max_image_size_px=1000))
    assert len(model.views) == count and not model.left_out
    assert np.median(model.errors_px) < 1.0
    if name == "fox":  # transforms.json: fl_x 1375.52
        assert model.views[0].camera.focal_px[0] == pytest.approx(1375.5, rel=0.01)


@needs_colmap
@pytest.mark.slow
def test_a_walk_forward_fails_with_a_reason(shared_data: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"move along the line of sight .* sideways"):
        find_picture_poses(shared_data / "multiview" / "lund_forward" / "images", tmp_path)


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


def test_depths_and_scale_of_what_a_view_observes() -> None:
    model = small_model()
    xy_px, depth = model.depths_in("b")
    np.testing.assert_allclose(depth, [5.5, 6.5], err_msg="z + 0.5 of points 2 and 1")
    np.testing.assert_allclose(xy_px, model.view("b").project(model.points[[2, 1]])[0])
    np.testing.assert_allclose(model.views[1].centre, [1.0, 0.0, -0.5])
    model = replace(small_model(), metres_per_unit=0.25)
    metric = model.scaled()
    np.testing.assert_allclose(metric.depths_in("b")[1], [1.375, 1.625])
    for before, after in zip(model.views, metric.views, strict=True):
        np.testing.assert_allclose(after.project(metric.points)[0], before.project(model.points)[0])
    assert metric.scaled().metres_per_unit == 1.0
    with pytest.raises(InputError, match="capture scale"):
        small_model().scaled()
    with pytest.raises(InputError, match=r"left out.*choose one of a, b"):
        small_model().view("c")
    with pytest.raises(InputError, match="got 'd':"):
        small_model().view("d")


def test_sparse_models_and_their_scale_survive_the_disk(tmp_path: Path) -> None:
    model = small_model()
    write_sparse_model(tmp_path, model)
    read = read_sparse_model(tmp_path)
    assert read.left_out == ("c",) and read.metres_per_unit is None
    for name in ("points", "errors_px", "observations", "observed_xy_px"):
        np.testing.assert_array_equal(getattr(read, name), getattr(model, name))
    for before, after in zip(model.views, read.views, strict=True):
        assert after.name == before.name and after.distortion == before.distortion
        np.testing.assert_array_equal(after.camera.camera_from_world, before.camera.camera_from_world)
    (tmp_path / "scale.json").write_text(json.dumps({"metres_per_unit": 0.5}))
    assert read_sparse_model(tmp_path).metres_per_unit == 0.5
    write_sparse_model(tmp_path, small_model())
    assert read_sparse_model(tmp_path).metres_per_unit is None, "another model has another unit"


def test_broken_models_are_named(tmp_path: Path) -> None:
    refused("capture poses", read_sparse_model, tmp_path)
    write_sparse_model(tmp_path, small_model())
    whole = (tmp_path / "points.npz").read_bytes()
    (tmp_path / "points.npz").write_bytes(whole[: len(whole) // 2])
    refused(r"points\.npz", read_sparse_model, tmp_path)
    refused("2 views and 3 points", replace, small_model(), observations=np.array([[0, 3]]), observed_xy_px=np.zeros((1, 2)))
    (tmp_path / "poses.json").write_text("{}")
    refused("expected format", read_sparse_model, tmp_path)
