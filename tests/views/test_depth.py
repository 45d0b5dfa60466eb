"""Dense depth of a whole scene: the shipped RAW stacks at half size with their true cameras in place of COLMAP's."""

import shutil
import sys
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from capture.cli import app
from capture.dataset.stack_writer import require_usable
from capture.dense.scene_depth import (
    PatchMatchScene,
    SceneDepthSettings,
    _focus_index,
    _picture,
    deepen_scene,
    focus_prior,
    is_depth_stale,
    nearest_views,
    nvidia_gpus,
    read_patch_match,
    run_patch_match,
)
from capture.merging.merge import merge_scene
from capture.merging.preferred_side import PREFERRED
from capture.merging.retouch import RETOUCHES
from capture.poses.colmap_job import ColmapJob, ColmapPicture, job_to_json
from capture.poses.sparse_model import SparseModel, SparseView, read_sparse_model, write_sparse_model
from capture.stacks.ingest import IngestSettings, ingest
from capture.stacks.stack_ingest import Development
from mrbokeh.demo.plan import DATA, VIEWS
from mrbokeh.depth.views.dense_depth import DenseDepth
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.images.image_io import read_image
from mrbokeh.images.picture_codec import stored_rgb
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import DEPTH_SOURCE, FocalStack, Slice, find_focal_stacks, read_focal_stack, write_focal_stack, write_merged
from mrbokeh.system.atomic_files import write_json
from tests.support.capture_truth import ViewTruth, picture_db, view_truth
from tests.support.command_line import printed_by
from tests.support.refusals import refused

RAW = DATA / "raw_stack"
POINTS_A_VIEW = 400
SMALL, SMALL_FOCUS_M = (24, 32), (0.8, 1.0, 1.25)


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


def test_what_is_missing_is_said_before_anything_changes(small: Path, tmp_path: Path) -> None:
    scene = tmp_path / "without"
    shutil.copytree(small, scene, ignore=shutil.ignore_patterns("reconstruction", "without"))
    refused("capture poses", printed_by, app, "depth", scene)
    write_sparse_model(scene / "reconstruction", read_sparse_model(small / "reconstruction"))
    refused("capture scale", deepen_scene, scene)
    assert len(find_focal_stacks(scene)) == 2
    # The package pycolmap of the extra is built without CUDA.
    write_json(scene / "reconstruction" / "scale.json", {"metres_per_unit": 1.0})
    refused("pycolmap-cuda12", deepen_scene, scene, SceneDepthSettings(patch_match=True))
    assert not list(scene.rglob("first_pass"))


def test_depths_of_patch_match_come_in_metres(small: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its maps are in COLMAP's unit, here half a metre: a map of 3 units is 1.5 m. COLMAP itself is stood in for."""
    scene, model = tmp_path / "desk", replace(read_sparse_model(small / "reconstruction"), metres_per_unit=0.5)
    job = ColmapJob((ColmapPicture("a", "a.png", "", 0),), (None,))
    write_json(scene / "reconstruction" / "colmap_job.json", job_to_json(job))
    ran: list[Path] = []
    monkeypatch.setattr("capture.dense.scene_depth.patch_match_obstacle", lambda: None)
    monkeypatch.setattr("capture.dense.scene_depth.run_patch_match", lambda _s, _p, folder: (folder.mkdir(), ran.append(folder)))
    monkeypatch.setattr("capture.dense.scene_depth.read_patch_match", lambda *_: np.full((2, 3), 3.0, np.float32))
    for _ in range(2):
        found = PatchMatchScene(scene, model).depths_in("a")
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


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """Two merged stacks of 32 x 24 px, 0.14 m apart, focused at 0.8, 1 and 1.25 m, with poses in metres of 25 points about 1 m away.

    The first pass found slice 1 everywhere, 1 m, and is grey; the slices hold 0.2, 0.3 and 0.4. The pupil is 0.25 m wide: blur
    grows by 12 px per dioptre.
    """
    lens = Lens(50.0, 0.2, focus_distance_m=1.0)
    for name in ("a", "b"):
        folder = tmp_path / name
        for index, level in enumerate((0.2, 0.3, 0.4)):
            write_camera_rgb(folder / f"{index}.exr", np.full((*SMALL, 3), level, np.float32), None)
        slices = tuple(Slice(f"{index}.exr", distance_m) for index, distance_m in enumerate(SMALL_FOCUS_M))
        one = np.ones(SMALL, np.float32)
        write_merged(folder, np.full((*SMALL, 3), 0.5, np.float32), one, one, one)
        metadata = {DEPTH_SOURCE: "focus", RETOUCHES: [{"slice": 1, "source": "b.png", "mask": "man.png", "share": 0.1}], PREFERRED: "near"}
        write_focal_stack(FocalStack(folder, slices, lens, registered=True, merged=True, metadata=metadata))
    points = np.random.default_rng(1).uniform([-0.1, -0.1, 0.95], [0.1, 0.1, 1.05], (25, 3))
    views = tuple(SparseView(name, at(x_m)) for name, x_m in (("a", 0.0), ("b", 0.14)))
    observations = np.array([(view, point) for view in range(2) for point in range(25)])
    write_scaled_model(tmp_path, SparseModel(views, points, np.zeros(25), observations, np.zeros((50, 2))))
    return tmp_path


def stand_in(monkeypatch: pytest.MonkeyPatch, depth_m: float, confidence: float) -> list[Any]:
    """Let every depth be this; returns what the search was given."""
    given: list[Any] = []

    def found(*arguments: object) -> DenseDepth:
        given.append(arguments)
        return DenseDepth(np.full(SMALL, depth_m, np.float32), np.full(SMALL, confidence, np.float32), np.zeros(SMALL, np.uint8))

    monkeypatch.setattr("capture.dense.scene_depth.dense_depth", found)
    return given


@pytest.mark.parametrize(("confidence", "level"), [(0.3, 0.5), (0.6, 0.4)])
def test_a_trusted_depth_picks_the_slice_and_a_doubted_one_leaves_the_first_picture(
    small: Path, monkeypatch: pytest.MonkeyPatch, confidence: float, level: float
) -> None:
    """At 1.25 m slice 2 is sharp, which holds 0.4; the first picture is 0.5. What belongs to the first picture is not kept with it."""
    given = stand_in(monkeypatch, 1.25, confidence)
    done = deepen_scene(small)
    assert [stack.folder.name for stack in done.stacks] == ["a", "b"] and done.left_out == ()
    stack = read_focal_stack(small / "a")
    assert not {RETOUCHES, PREFERRED} & stack.metadata.keys()
    np.testing.assert_allclose(stack.all_in_focus(), level, atol=2e-3)
    np.testing.assert_allclose(stack.depth_m(), 1.25, rtol=1e-6)
    np.testing.assert_allclose(stack.focus_index(), 2.0, atol=1e-5)
    np.testing.assert_allclose(stack.depth_confidence(), confidence, rtol=1e-6)
    assert stored_rgb(small / "a" / "all_in_focus.png").shape == (*SMALL, 3) and (small / "a" / "merge.png").is_file()
    # What the search was given: pictures and cameras of one size, focus at 1 m, and the points.
    _, reference, neighbours, (first, last), priors, _ = given[0]
    assert len(neighbours) == 1 and reference.camera.width_px == neighbours[0].camera.width_px == 32
    assert reference.camera.focal_px[0] == pytest.approx(30.0), "COLMAP saw 96 px of width and a focal length of 90 px"
    assert (first, last) == pytest.approx((1.0 / 1.05, 1.0 / 0.95), abs=0.02)
    np.testing.assert_allclose(priors.focus.dioptre, 1.0)
    np.testing.assert_allclose(priors.focus.trust, 1.0)
    assert priors.focus.step_dioptre == pytest.approx(0.225), "(1 / 0.8 - 1 / 1.25) / 2"


def test_depth_is_kept_until_what_it_was_made_from_changes(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The first pass stays the input of every run."""
    given = stand_in(monkeypatch, 1.25, 0.6)
    deepen_scene(small)
    deepen_scene(small)
    assert len(given) == 2, "nothing is found again"
    stack = read_focal_stack(small / "a")
    record = stack.metadata[DEPTH_SOURCE]
    assert (record["method"], record["neighbours"], record["focus_distances_m"]) == ("plane sweep and focus", ["b"], list(SMALL_FOCUS_M))
    assert 0.95 <= record["nearest_point_m"] < 1.0 and not is_depth_stale(stack)
    assert is_depth_stale(replace(stack, slices=tuple(replace(each, focus_distance_m=1.1) for each in stack.slices)))
    assert not is_depth_stale(replace(stack, metadata={DEPTH_SOURCE: "focus"}))
    deepen_scene(small, SceneDepthSettings(overwrite=True))
    assert len(given) == 4
    np.testing.assert_allclose(given[3][4].focus.dioptre, 1.0, err_msg="of the first pass, not 0.8 of the depth found before")
    write_json(small / "reconstruction" / "scale.json", {"metres_per_unit": 1.01})
    deepen_scene(small)
    assert len(given) == 6, "another scale"


def test_highlights_take_the_trust_of_focus_and_unknown_focus_votes_nothing(small: Path) -> None:
    """The largest blur is that of slice 0 at 1.25 m, 5.3 px: within half of it, rounded up, and a pixel of the light nothing is trusted."""
    stack, rgb = read_focal_stack(small / "a"), np.full((*SMALL, 3), 0.5, np.float32)
    rgb[0, 0] = 4.0
    vote = focus_prior(stack, rgb)
    assert vote is not None and vote.trust[0, :6].tolist() == [0.0] * 5 + [1.0]
    unknown = replace(stack, slices=tuple(replace(each, focus_distance_m=None) for each in stack.slices))
    assert focus_prior(unknown, rgb) is None
    found = DenseDepth(np.full(SMALL, 1.25, np.float32), np.ones(SMALL, np.float32), np.zeros(SMALL, np.uint8))
    np.testing.assert_array_equal(_picture(unknown, found), 0.5)
    np.testing.assert_array_equal(_focus_index(unknown, found.depth_m), 1.0)


def test_scenes_that_cannot_have_dense_depth_are_refused(small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    model, guessed = read_sparse_model(small / "reconstruction"), read_focal_stack(small / "b")
    given = stand_in(monkeypatch, 1.0, 1.0)
    few = model.observations[:, 1] < 19
    write_scaled_model(small, replace(model, observations=model.observations[few], observed_xy_px=model.observed_xy_px[few]))
    refused("a sees 19 points of the sparse model, but its range of depths needs 20", deepen_scene, small)
    write_focal_stack(replace(guessed, metadata={"metres": {"known": False}}))
    refused(r"two placed stacks or more whose focus is known in metres .* has 1: photograph more", deepen_scene, small)
    write_focal_stack(replace(guessed, merged=False))
    refused("expected merged stacks in .*, but b are not: run `mrbokeh capture merge` first", deepen_scene, small)
    assert not given


def test_what_keeps_patch_match_from_running_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The driver is asked before COLMAP, which ends the process where there is no GPU. A count needs both answers of the driver."""
    camera = at(0.0)
    monkeypatch.setitem(sys.modules, "pycolmap", SimpleNamespace(has_cuda=True))
    refused(r"depth map of PatchMatch at .*a\.png\.geometric\.bin, found none", read_patch_match, tmp_path, "a.png", camera, (0.0, 0.0))
    for starts, counts, gpus in ((0, 0, 2), (100, 0, 0), (0, 100, 0)):
        driver = SimpleNamespace(cuInit=lambda _, code=starts: code, cuDeviceGetCount=lambda count, code=counts: two_into(count, code))
        monkeypatch.setattr("ctypes.CDLL", lambda _, driver=driver: driver)
        assert nvidia_gpus() == gpus
    monkeypatch.setattr("ctypes.CDLL", Mock(side_effect=OSError))
    assert nvidia_gpus() == 0
    run = (run_patch_match, tmp_path, tmp_path, tmp_path)
    refused("needs an NVIDIA GPU, and its driver finds none: leave out --patch-match", *run)
    monkeypatch.setitem(sys.modules, "pycolmap", None)
    refused("not installed: pip install pycolmap-cuda12", *run)


def two_into(count: Any, code: int) -> int:
    count._obj.value = 2
    return code
