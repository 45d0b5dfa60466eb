"""Poses, scale and focus of a traced scene from pictures alone, against its true cameras, metres and focus distances."""

import json
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest

from capture.poses.colmap import PoseSettings, find_scene_poses
from capture.poses.lens_calibration import read_lens_calibration
from capture.poses.sparse_model import SparseModel, read_sparse_model
from capture.scale.board import BoardSearch, Similarity, umeyama
from capture.scale.metric_scale import ScaledScene, ScaleRequest, scale_lines, scale_scene
from mrbokeh.images.color import display_rgb8
from mrbokeh.stacks.focal_stack import read_focal_stack
from mrbokeh.stacks.guessed_metres import stated_distances_m
from mrbokeh.system.errors import InputError
from tests.support.traced_views import (
    BOARD,
    FOCUS_M,
    LENS,
    POSITIONS_M,
    WIDTH_PX,
    Traced,
    board_corners_m,
    registered_slices,
    traced,
    true_camera,
    write_views,
)

pytestmark = pytest.mark.skipif(find_spec("pycolmap") is None, reason="pycolmap (extra `capture`) is not installed")

DISTANCE_M = float(np.linalg.norm(POSITIONS_M[5]))


@pytest.fixture(scope="module")
def pictures() -> Traced:
    return traced()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, pictures: Traced) -> Path:
    scene = tmp_path_factory.mktemp("scene")
    write_views(scene, pictures)
    return scene


@pytest.fixture(scope="module")
def focused(tmp_path_factory: pytest.TempPathFactory, pictures: Traced) -> Path:
    """The scene with the slices of view 0, ten times as long to trace, and its poses."""
    scene = tmp_path_factory.mktemp("focused")
    write_views(scene, pictures, registered_slices())
    find_scene_poses(scene)
    return scene


@pytest.fixture(scope="module")
def model(folder: Path) -> SparseModel:
    return find_scene_poses(folder)


@pytest.fixture(scope="module")
def truth(model: SparseModel) -> Similarity:
    """From the model to the true world, by the centres of the cameras."""
    return umeyama(np.array([view.centre for view in model.views]), np.array(POSITIONS_M))


@pytest.fixture(scope="module")
def scaled(focused: Path) -> ScaledScene:
    assert len(read_sparse_model(focused / "reconstruction").views) == len(POSITIONS_M)
    return scale_scene(focused, ScaleRequest(BOARD, ("view_0", "view_5", DISTANCE_M)))


def test_corners_of_the_board_are_where_they_are(pictures: Traced) -> None:
    """RMS over six views: 0.069 px were measured, for 105 of 120 corners; the search before had 0.073 px for 98."""
    off_px = []
    for view, sharp in enumerate(pictures.sharp):
        found = BoardSearch(BOARD).corners(display_rgb8(sharp))
        off_px.append(found.xy_px - true_camera(view).project(board_corners_m()[found.ids])[0])
    assert sum(map(len, off_px)) >= 100
    assert np.sqrt(np.mean(np.sum(np.concatenate(off_px) ** 2, axis=1))) < 0.08


def test_poses_of_all_views_and_depth_of_their_points(model: SparseModel, truth: Similarity, pictures: Traced) -> None:
    """A tenth of a millimetre at 1 m is a twentieth of a pixel here; the focal length is the breathing one of the nearest focus."""
    assert [view.name for view in model.views] == [f"view_{index}" for index in range(len(POSITIONS_M))] and not model.left_out
    centres = np.array([view.centre for view in model.views])
    assert np.linalg.norm(truth(centres) - POSITIONS_M, axis=1).max() < 2e-4
    for index, view in enumerate(model.views):
        turned = view.camera.camera_from_world[:3, :3] @ truth.rotation.T @ true_camera(index).camera_from_world[:3, :3].T
        assert np.degrees(np.arccos(np.clip((np.trace(turned) - 1.0) / 2.0, -1.0, 1.0))) < 0.1
    assert model.views[0].camera.focal_px[0] == pytest.approx(LENS.focal_px(WIDTH_PX), rel=2e-3)
    assert len({view.camera.focal_px for view in model.views}) == 1, "one camera for one reference focus"
    for index, view in enumerate(model.views):
        xy_px, depth = model.depths_in(view)
        true_m = pictures.depth_m[index][xy_px[:, 1].astype(int), xy_px[:, 0].astype(int)]
        assert np.median(np.abs(depth * truth.scale / true_m - 1.0)) < 2e-3


@pytest.mark.slow
def test_finding_poses_again_changes_nothing(folder: Path, model: SparseModel, tmp_path: Path, pictures: Traced) -> None:
    """Kept where they are; and from the start, with the same seed, the same cameras.

    Not to the last bit: threads finish their features and matches in another order, and COLMAP draws from them in that order.
    """
    before = (folder / "reconstruction" / "poses.json").stat().st_mtime_ns
    find_scene_poses(folder)
    assert (folder / "reconstruction" / "poses.json").stat().st_mtime_ns == before
    write_views(tmp_path, pictures)
    again = find_scene_poses(tmp_path, PoseSettings(threads=2))
    assert [view.name for view in again.views] == [view.name for view in model.views]
    first, second = (np.array([view.centre for view in each.views]) for each in (model, again))
    off = np.linalg.norm(umeyama(second, first)(second) - first, axis=1).max() / np.ptp(first, axis=0).max()
    assert off < 2e-4
    assert again.views[0].camera.focal_px[0] == pytest.approx(model.views[0].camera.focal_px[0], rel=2e-4)


@pytest.mark.slow
def test_an_interrupted_run_goes_on_with_its_matches(folder: Path, model: SparseModel, tmp_path: Path, pictures: Traced) -> None:
    """Without the poses but with the database, features and matches are not found again: their rows stay as they are."""
    write_views(tmp_path, pictures)
    for name in ("database.db", "colmap_job.json"):
        target = tmp_path / "reconstruction" / name
        target.parent.mkdir(exist_ok=True)
        target.write_bytes((folder / "reconstruction" / name).read_bytes())
    find_scene_poses(tmp_path, PoseSettings(mapper="global"))
    logs = [(each / "reconstruction" / "colmap.log").read_text() for each in (folder, tmp_path)]
    assert ["Creating SIFT" in log for log in logs] == [True, False]
    assert ["Processing block" in log for log in logs] == [True, False]
    assert len(read_sparse_model(tmp_path / "reconstruction").views) == len(model.views)


@pytest.mark.slow
def test_scale_focus_and_growth_of_blur_are_found(focused: Path, scaled: ScaledScene) -> None:
    """At 400 px the board's squares have 25 px and a point's focus is known to 0.006 dioptres; larger pictures do better."""
    views = read_sparse_model(focused / "reconstruction").views
    truth = umeyama(np.array([view.centre for view in views]), np.array(POSITIONS_M))
    off = {each.method: each.metres_per_unit / truth.scale - 1.0 for each in scaled.result.answers}
    assert list(off) == ["board", "distance", "focus"]
    assert abs(off["board"]) < 2e-3 and abs(off["distance"]) < 1e-3 and abs(off["focus"]) < 5e-3
    assert scaled.result.contradictions == ()
    # Within a tenth of a pixel of blur: 0.02 dioptres at 7 px each, where the slices are 0.15 apart; the growth within 4 %.
    fit = scaled.calibrated["view_0"].fit
    np.testing.assert_allclose(fit.dioptres, 1.0 / np.array(FOCUS_M), atol=0.02)
    stack = read_focal_stack(focused / "view_0")
    thin = [LENS.focused_at(d).coc_px_per_dioptre(WIDTH_PX) * each.scale for d, each in zip(FOCUS_M, stack.slices, strict=True)]
    np.testing.assert_allclose(fit.px_per_dioptre, thin, rtol=0.04)
    told = "\n".join(scale_lines(scaled))
    assert "board: " in told and "% from the one used" in told and "px per dioptre" in told


@pytest.mark.slow
def test_scale_and_calibration_are_written_and_kept(focused: Path, scaled: ScaledScene) -> None:
    folder = focused
    document = json.loads((folder / "reconstruction" / "scale.json").read_text())
    assert document["used"] == "board" and set(document["disagreement"]) == {"distance", "focus"}
    metric = read_sparse_model(folder / "reconstruction").scaled()
    baseline_m = np.linalg.norm(metric.view("view_0").centre - metric.view("view_5").centre)
    assert baseline_m == pytest.approx(DISTANCE_M, rel=2e-3)
    calibration = read_lens_calibration(folder / "lens_calibration.json")
    assert len(calibration.rows) == len(FOCUS_M) and calibration.focal_length_mm == LENS.focal_length_mm
    stack = read_focal_stack(folder / "view_0")
    assert stack.camera is not None and stack.camera.focal_px == metric.view("view_0").camera.focal_px
    assert stack.metadata["distortion"] == list(metric.view("view_0").distortion)
    assert stated_distances_m(stack) == pytest.approx(FOCUS_M)
    kept = scale_scene(focused, ScaleRequest())
    assert kept.result.used.metres_per_unit == scaled.result.used.metres_per_unit


@pytest.mark.usefixtures("model")
def test_nothing_to_go_by_is_said(tmp_path: Path, folder: Path) -> None:
    (tmp_path / "reconstruction").mkdir()
    for name in ("poses.json", "points.npz"):
        (tmp_path / "reconstruction" / name).write_bytes((folder / "reconstruction" / name).read_bytes())
    with pytest.raises(InputError, match=r"scale in metres stays unknown\. board: none was given .* focus: the scene has no merged stacks"):
        scale_scene(tmp_path, ScaleRequest())
