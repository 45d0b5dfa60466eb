"""Dense depth of a whole scene: the shipped RAW stacks at half size with their true cameras in place of COLMAP's."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from capture.cli import app
from capture.dataset.stack_writer import require_usable
from capture.dense.scene_depth import PatchMatchScene, SceneDepthSettings, deepen_scene, nearest_views
from capture.merging.merge import merge_scene
from capture.poses.colmap_job import ColmapJob, ColmapPicture, job_to_json
from capture.poses.sparse_model import SparseModel, SparseView, read_sparse_model, write_sparse_model
from capture.stacks.ingest import IngestSettings, ingest
from capture.stacks.stack_ingest import Development
from mrbokeh.demo.plan import DATA, VIEWS
from mrbokeh.depth.views.dense_depth import DenseDepth
from mrbokeh.images.image_io import read_image
from mrbokeh.optics.camera import Camera
from mrbokeh.stacks.focal_stack import DEPTH_SOURCE, find_focal_stacks, read_focal_stack
from mrbokeh.system.atomic_files import write_json
from tests.support.capture_truth import ViewTruth, picture_db, view_truth
from tests.support.command_line import printed_by
from tests.support.refusals import refused

RAW = DATA / "raw_stack"
POINTS_A_VIEW = 400


def reduced(truth: ViewTruth) -> ViewTruth:
    """At half the size: means of light, the depth of one of four pixels."""
    rgb = 0.25 * sum(truth.rgb[y::2, x::2] for y in (0, 1) for x in (0, 1))
    height, width = rgb.shape[:2]
    return ViewTruth(truth.camera.resized(width, height), rgb, truth.depth_m[::2, ::2], truth.card[::2, ::2])


def true_model(truths: list[ViewTruth]) -> SparseModel:
    """Points on the surfaces, each seen by the views that have nothing before it; half a pixel off, as `reduced` depth is."""
    rng = np.random.default_rng(0)
    points, observations, xy_px = [], [], []
    views = tuple(SparseView(name, truth.camera) for name, truth in zip(VIEWS, truths, strict=True))
    for truth in truths:
        pixels = truth.camera.pixel_centres_px().reshape(-1, 2)[rng.permutation(truth.depth_m.size)[:POINTS_A_VIEW]]
        depths_m = truth.depth_m[tuple(np.floor(pixels[:, ::-1]).astype(int).T)]
        for point in truth.camera.unproject(pixels, depths_m):
            seen = [(index, xy) for index, other in enumerate(truths) if (xy := where_seen(other, point)) is not None]
            if len(seen) > 1:
                observations += [(index, len(points)) for index, _ in seen]
                xy_px += [xy for _, xy in seen]
                points.append(point)
    return SparseModel(views, np.array(points), np.full(len(points), 0.1), np.array(observations), np.array(xy_px))


def write_scaled_model(scene: Path, model: SparseModel) -> None:
    write_sparse_model(scene / "reconstruction", model)
    write_json(scene / "reconstruction" / "scale.json", {"metres_per_unit": 1.0})


def where_seen(truth: ViewTruth, point_m: np.ndarray) -> np.ndarray | None:
    xy_px, depth_m = truth.camera.project(point_m)
    column, row = np.floor(xy_px).astype(int)
    height, width = truth.depth_m.shape
    inside = 0 <= column < width and 0 <= row < height
    return xy_px if inside and abs(truth.depth_m[row, column] / depth_m - 1.0) < 0.01 else None


@pytest.fixture(scope="module")
def truths() -> list[ViewTruth]:
    return [reduced(view_truth(RAW, index)) for index in range(len(VIEWS))]


@pytest.fixture(scope="module")
def merged(tmp_path_factory: pytest.TempPathFactory, truths: list[ViewTruth]) -> Path:
    """The three views developed at half size, merged, with true poses in metres."""
    pytest.importorskip("rawpy", reason="rawpy comes with the extra 'capture'")
    scene = tmp_path_factory.mktemp("scene") / "desk"
    ingest([RAW / name for name in VIEWS], scene, IngestSettings(development=Development(half_size=True), sidecar=RAW / "lens.toml"))
    merge_scene(scene)
    write_scaled_model(scene, true_model(truths))
    return scene


@pytest.fixture(scope="module")
def deepened(merged: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    scene = shutil.copytree(merged, tmp_path_factory.mktemp("deep") / "desk")
    deepen_scene(scene)
    return scene


@pytest.mark.parametrize("view", range(3))
@pytest.mark.slow
def test_depth_is_several_times_as_exact_as_focus_alone_and_the_picture_no_worse(
    merged: Path, deepened: Path, truths: list[ViewTruth], view: int
) -> None:
    """At half size a step of 0.5 px in the widest neighbour is 0.6 % of the depth at 1 m; focus alone has 1.5 % and more."""
    truth = truths[view]
    errors = {
        scene.parent.name: np.abs(read_focal_stack(scene / VIEWS[view]).depth_m() / truth.depth_m - 1.0)[truth.inner]
        for scene in (merged, deepened)
    }
    before, after = (errors[scene.parent.name] for scene in (merged, deepened))
    assert np.median(after) < 0.006
    assert np.median(after) < 0.5 * np.median(before)
    truth, name = truths[view], VIEWS[view]
    before, after = (picture_db(read_focal_stack(scene / name).all_in_focus(), truth.rgb, truth.inner) for scene in (merged, deepened))
    assert after > before - 0.1
    kept = read_image(deepened / name / "first_pass" / "all_in_focus.exr")
    np.testing.assert_array_equal(kept, read_image(merged / name / "all_in_focus.exr"))


@pytest.mark.slow
def test_confidence_tells_good_from_bad(deepened: Path, truths: list[ViewTruth]) -> None:
    """What is trusted is off by 0.05 dioptres several times less often than what is not."""
    stack, truth = read_focal_stack(deepened / VIEWS[0]), truths[0]
    off = np.abs(1.0 / stack.depth_m() - 1.0 / truth.depth_m) > 0.05
    trusted = stack.depth_confidence() > 0.5
    assert trusted[truth.inner].mean() > 0.5
    assert off[trusted & truth.inner].mean() < 0.35 * off[~trusted & truth.inner].mean()


@pytest.mark.slow
def test_finished_stacks_are_kept_and_stale_ones_are_not(deepened: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another scale makes all of them stale; the depth that is found then is a stand-in."""
    scene = tmp_path / "desk"
    shutil.copytree(deepened, scene)
    stacks = [read_focal_stack(scene / name) for name in VIEWS]
    before = [stack.depth_path.stat().st_mtime_ns for stack in stacks]
    assert stacks[1].metadata[DEPTH_SOURCE]["neighbours"]
    depth_m = stacks[0].depth_m().astype(np.float32)
    found = DenseDepth(depth_m, np.ones_like(depth_m), np.zeros(depth_m.shape, np.uint8))
    monkeypatch.setattr("capture.dense.scene_depth.dense_depth", lambda *_: found)
    deepen_scene(scene)
    assert [stack.depth_path.stat().st_mtime_ns for stack in stacks] == before
    write_json(scene / "reconstruction" / "scale.json", {"metres_per_unit": 1.01})
    deepen_scene(scene)
    assert all(stack.depth_path.stat().st_mtime_ns != old for stack, old in zip(stacks, before, strict=True))


@pytest.mark.slow
def test_depth_of_another_focus_does_not_go_into_a_data_set(deepened: Path) -> None:
    """As after `scale --overwrite` with another distance, which calibrates the focus anew."""
    stack = read_focal_stack(deepened / VIEWS[0])
    require_usable(stack)
    moved = tuple(replace(each, focus_distance_m=1.1 * (each.focus_distance_m or 0.0)) for each in stack.slices)
    refused("run `mrbokeh capture depth`", require_usable, replace(stack, slices=moved))


@pytest.mark.slow
def test_a_stack_without_a_pose_keeps_its_depth_from_focus(merged: Path, truths: list[ViewTruth], tmp_path: Path) -> None:
    scene = tmp_path / "desk"
    shutil.copytree(merged, scene)
    model = true_model(truths)
    kept = model.observations[:, 0] < 2
    write_scaled_model(
        scene, replace(model, views=model.views[:2], observations=model.observations[kept], observed_xy_px=model.observed_xy_px[kept])
    )
    before = (scene / VIEWS[2] / "depth.exr").read_bytes()
    result = deepen_scene(scene)
    assert result.left_out == (VIEWS[2],)
    assert (scene / VIEWS[2] / "depth.exr").read_bytes() == before


def test_what_is_missing_is_said_before_anything_changes(merged: Path, tmp_path: Path) -> None:
    scene = tmp_path / "desk"
    shutil.copytree(merged, scene, ignore=shutil.ignore_patterns("reconstruction"))
    refused("capture poses", printed_by, app, "depth", scene)
    write_sparse_model(scene / "reconstruction", read_sparse_model(merged / "reconstruction"))
    refused("capture scale", deepen_scene, scene)
    assert len(find_focal_stacks(scene)) == 3
    # The package pycolmap of the extra is built without CUDA.
    write_json(scene / "reconstruction" / "scale.json", {"metres_per_unit": 1.0})
    refused("pycolmap-cuda12", deepen_scene, scene, SceneDepthSettings(patch_match=True))
    assert not list(scene.rglob("first_pass"))


def test_depths_of_patch_match_come_in_metres(merged: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its maps are in COLMAP's unit, here half a metre: a map of 3 units is 1.5 m. COLMAP itself is stood in for."""
    scene, model = tmp_path / "desk", replace(read_sparse_model(merged / "reconstruction"), metres_per_unit=0.5)
    job = ColmapJob((ColmapPicture(VIEWS[0], f"{VIEWS[0]}.png", "", 0),), (None,))
    write_json(scene / "reconstruction" / "colmap_job.json", job_to_json(job))
    ran: list[Path] = []
    monkeypatch.setattr("capture.dense.scene_depth.patch_match_obstacle", lambda: None)
    monkeypatch.setattr("capture.dense.scene_depth.run_patch_match", lambda _s, _p, folder: (folder.mkdir(), ran.append(folder)))
    monkeypatch.setattr("capture.dense.scene_depth.read_patch_match", lambda *_: np.full((2, 3), 3.0, np.float32))
    for _ in range(2):
        found = PatchMatchScene(scene, model).depths_in(VIEWS[0])
    np.testing.assert_array_equal(found.depth_m, 1.5)
    assert len(found.xy_px) == 6 and len(ran) == 1, "what is finished is not run again"


def test_neighbours_are_those_with_parallax_and_common_points() -> None:
    """Points 1 m away; cameras 1 mm, 0.14 m (8 degrees) and 1 m beside the first: the second tells most, the first nothing to speak of."""
    points = np.random.default_rng(1).uniform([-0.1, -0.1, 0.95], [0.1, 0.1, 1.05], (50, 3))
    views = tuple(SparseView(name, at(x_m)) for name, x_m in (("me", 0.0), ("same", 0.001), ("good", 0.14), ("far", 1.0)))
    observations = np.array([(view, point) for view in range(4) for point in range(50)])
    model = SparseModel(views, points, np.zeros(50), observations, np.zeros((200, 2)), 1.0)
    assert [view.name for view in nearest_views(model, "me", 3)] == ["good", "far", "same"]


def at(x_m: float) -> Camera:
    pose = np.eye(4)
    pose[0, 3] = -x_m
    return Camera(96, 64, (90.0, 90.0), (48.0, 32.0), pose)
