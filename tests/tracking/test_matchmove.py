"""Match-move: drawn rooms with true cameras. COLMAP itself runs in the slow tests only."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.cli import app
from capture.matchmove import clip_matchmove
from capture.matchmove.clip_matchmove import MatchmoveSettings, matchmove_clip
from capture.matchmove.clip_solve import FLAT, TURNING, ClipSolve, begin_solving
from capture.matchmove.ground import GroundPicks, Ruler, on_ground, parse_frame_distance, parse_ground, parse_ruler, ruler_scale
from capture.matchmove.keyframes import chosen_keyframes, motion_of_clip
from capture.matchmove.space_solve import off_px, poses_between, rotation_only_residual_px
from capture.poses.sparse_model import SparseModel, SparseView
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.formats import read_track
from mrbokeh.tracking.camera_track.track import CameraTrack
from mrbokeh.video.clip import probe
from tests.support.command_line import printed_by
from tests.support.refusals import refused
from tests.support.textured_room import picture, room_camera, similarity
from tests.support.video_files import filmed


def walking(count: int) -> list[Camera]:
    """1.2 m to the right and 0.4 m ahead, looking about."""
    times = np.linspace(0.0, 1.0, count)
    return [room_camera((-0.8 + 1.2 * t, 0.1 * np.sin(6 * t), -0.3 + 0.4 * t), (0.2 * np.sin(5 * t), 0.05, 3.0)) for t in times]


def turning(count: int) -> list[Camera]:
    """On a tripod, by 40 degrees."""
    return [room_camera((0.0, 0.0, 0.0), (2.5 * t - 1.2, 0.1, 3.0)) for t in np.linspace(0.0, 1.0, count)]


def write_clip(path: Path, cameras: Sequence[Camera]) -> Path:
    light = ((picture(camera).astype(np.float32) / 255.0) ** 2.2 for camera in cameras)
    return filmed(path, (np.repeat(each[..., None], 3, axis=2).astype(np.float32) for each in light), 24)


def wall_points(count: int = 400) -> np.ndarray:
    """On the far wall (z = 3.5) and the floor (y = 0.8) of the room."""
    rng = np.random.default_rng(0)
    wall = np.column_stack([rng.uniform(-2.0, 1.4, count), rng.uniform(-1.2, 0.7, count), np.full(count, 3.5)])
    floor = np.column_stack([rng.uniform(-1.5, 1.4, count), np.full(count, 0.8), rng.uniform(1.5, 3.4, count)])
    return np.concatenate([wall, floor])


def model_of(cameras: Sequence[Camera], noise_px: float = 0.0) -> SparseModel:
    """As COLMAP would have it, but true."""
    points, rng = wall_points(), np.random.default_rng(1)
    observations, places = [], []
    for index, camera in enumerate(cameras):
        xy_px, depth = camera.project(points)
        inside = np.flatnonzero((depth > 0) & (xy_px > 5).all(axis=1) & (xy_px[:, 0] < 395) & (xy_px[:, 1] < 295))
        observations.append(np.column_stack([np.full(len(inside), index), inside]))
        places.append(xy_px[inside] + rng.normal(0.0, noise_px, (len(inside), 2)))
    views = tuple(SparseView(f"frame_{index:06d}", camera) for index, camera in enumerate(cameras))
    return SparseModel(views, points, np.zeros(len(points)), np.concatenate(observations), np.concatenate(places))


def errors(cameras: Sequence[Camera], track: CameraTrack) -> tuple[float, float]:
    """(absolute trajectory error in metres after the best similarity, RMS; largest error of rotation in degrees) (Sturm et al. 2012)."""
    numbers = track.numbers
    true = np.array([cameras[n].world_from_camera[:3, 3] for n in numbers])
    found = np.array([track.at(n).camera.world_from_camera[:3, 3] for n in numbers])
    scale, turn = similarity(true, found)
    off_m = scale * (found - found.mean(axis=0)) @ turn.T + true.mean(axis=0) - true
    poses = [(each.camera_from_world[:3, :3] for each in (cameras[n], track.at(n).camera)) for n in numbers]
    turns = [Rotation.from_matrix(one @ turn @ other.T).magnitude() for one, other in poses]
    return float(np.sqrt(np.mean(np.sum(off_m**2, axis=1)))), float(np.degrees(max(turns)))


def test_keyframes_spread_over_the_motion_and_not_over_the_time() -> None:
    """Rests for 50 frames, moves by half a width in 50, rests: the rest gets its ends, the motion the others."""
    motion = np.concatenate([np.zeros(50), np.linspace(0.0, 0.5, 50), np.full(50, 0.5)])
    chosen = chosen_keyframes(motion, 40)
    assert chosen[0] == 0 and chosen[-1] == 149 and 10 < len(chosen) < 25
    assert sum(49 <= number <= 101 for number in chosen) >= len(chosen) - 3
    assert len(chosen_keyframes(motion, 9)) <= 11 and chosen_keyframes(motion[:5], 40) == [0, 1, 2, 3, 4]


def test_the_motion_of_a_clip_is_that_of_its_picture(tmp_path: Path) -> None:
    """Turning by atan(1.3 / 3) + atan(1.2 / 3) about: near the middle 304 px times the angle's tangent, in widths of 320 px."""
    clip = write_clip(tmp_path / "clip.mkv", [camera.resized(320, 240) for camera in turning(9)])
    motion = motion_of_clip(clip, probe(clip))
    angle = np.arctan(1.3 / 3.0) + np.arctan(1.2 / 3.0)
    assert motion[-1] == pytest.approx(304.0 * angle / 320.0, rel=0.15) and (np.diff(motion) > 0).all()


def test_frames_between_keyframes_come_from_flow_from_one_end_as_well() -> None:
    """Seven frames, the outer two known: the others to within 5 mm and 0.1 degrees, with points of the model carried over 3 frames."""
    cameras = walking(25)[:7]
    model, greys = model_of([cameras[0], cameras[-1]]), [picture(camera) for camera in cameras]
    found = poses_between(model, greys, {0: model.views[0], 6: model.views[1]})
    assert sorted(found) == [1, 2, 3, 4, 5]
    for place, pose in found.items():
        true, motion = cameras[place], pose.camera.camera_from_world @ cameras[place].world_from_camera
        assert np.linalg.norm(pose.camera.world_from_camera[:3, 3] - true.world_from_camera[:3, 3]) < 0.005
        assert np.degrees(Rotation.from_matrix(motion[:3, :3]).magnitude()) < 0.1
        assert pose.residual_px < 0.5 and pose.fitting > 0.9
    model = model_of([cameras[3]])
    found = poses_between(model, greys[:4], {3: model.views[0]})
    assert sorted(found) == [0, 1, 2]
    assert np.linalg.norm(found[0].camera.world_from_camera[:3, 3] - cameras[0].world_from_camera[:3, 3]) < 0.01


def test_turning_is_told_from_walking() -> None:
    """Corners off by 0.1 px: turning explains a turning camera to that noise, a walking one not."""
    still, moved = (model_of(cameras, 0.1) for cameras in (turning(6), walking(6)))
    # Away from the noise's own median of 0.118 px, what is fitted takes a little with it.
    still_px, moved_px = (float(np.median(off_px(model))) for model in (still, moved))
    assert rotation_only_residual_px(still) < 1.3 * still_px == pytest.approx(1.3 * 0.1177, rel=0.05)
    assert rotation_only_residual_px(moved) > 5.0 * moved_px


FLOOR_POINTS = np.array([[-0.6, 0.8, 2.0], [0.9, 0.8, 2.1], [0.8, 0.8, 3.3], [-0.7, 0.8, 3.2]])


def elsewhere(model: SparseModel) -> SparseModel:
    """As COLMAP leaves it: turned, shifted and in a unit of its own (0.37 of a metre)."""
    turn = np.eye(4)
    turn[:3, :3], turn[:3, 3] = Rotation.from_euler("xyz", (0.5, -0.8, 0.3)).as_matrix(), (2.0, -1.0, 0.7)
    return replace(model.moved(turn).times(1.0 / 0.37), metres_per_unit=None)


def test_the_world_stands_on_picked_ground_among_things_that_stand_on_it() -> None:
    """Pixels of four known points of the floor, read to 0.1 px: the first is the origin, the second lies 1.503 m along x, y is down."""
    cameras = walking(6)
    view_px = np.round(cameras[2].project(FLOOR_POINTS)[0], 1)
    picks, true_m = GroundPicks(2, view_px), float(np.linalg.norm(FLOOR_POINTS[1] - FLOOR_POINTS[0]))
    model = elsewhere(model_of(cameras, 0.1))
    standing = on_ground(model, model.views[2], picks)
    metric = standing.times(ruler_scale(standing.views[2], Ruler(2, view_px[:2], true_m)))
    # 0.1 px at 2 m and 380 px of focal length are 0.5 mm across and, at 22 degrees to the floor, 1.4 mm along.
    on_floor = metric.points[len(metric.points) // 2 :]
    assert np.abs(on_floor[:, 1]).max() < 0.003
    seen_px, _ = metric.views[5].project(np.array([[0.0, 0.0, 0.0], [true_m, 0.0, 0.0]]))
    assert np.abs(seen_px - cameras[5].project(FLOOR_POINTS[:2])[0]).max() < 0.5
    heights_m = [0.8 - camera.world_from_camera[1, 3] for camera in cameras]
    assert [-view.centre[1] for view in metric.views] == pytest.approx(heights_m, abs=0.003)
    # A third of the points between the picks is lifted by 5 to 40 cm.
    model = model_of(cameras)
    lifted = np.random.default_rng(4).random(len(model.points)) < 0.33
    points = model.points - np.where(lifted, np.random.default_rng(5).uniform(0.05, 0.4, len(lifted)), 0.0)[:, None] * (0.0, 1.0, 0.0)
    standing = on_ground(replace(model, points=points), model.views[2], GroundPicks(2, cameras[2].project(FLOOR_POINTS)[0]))
    assert standing.views[2].centre[1] == pytest.approx(cameras[2].world_from_camera[1, 3] - 0.8, abs=1e-6)


def test_bad_picks_are_refused() -> None:
    cameras = walking(6)
    model = model_of(cameras)
    floor_px = cameras[2].project(FLOOR_POINTS)[0]
    with pytest.raises(InputError, match="0 points of the model lie between"):
        on_ground(model, model.views[2], GroundPicks(2, floor_px[0] + [[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]]))
    scattered = replace(model, points=model.points + np.random.default_rng(0).normal(0.0, 0.3, model.points.shape))
    refused("lie on one plane", on_ground, scattered, model.views[2], GroundPicks(2, floor_px))
    standing = on_ground(model, model.views[2], GroundPicks(2, floor_px))
    refused("above the horizon", ruler_scale, standing.views[2], Ruler(2, np.array([[200.0, 5.0], [220.0, 250.0]]), 1.0))
    refused("positive number of metres", ruler_scale, standing.views[2], Ruler(2, floor_px[:2], -1.0))


def test_grounds_rulers_and_distances_that_nobody_can_read_are_refused() -> None:
    for parse, texts in (
        (parse_ground, ("", "0", "0:1,2/3,4", "x:1,2/3,4/5,6", "-1:1,2/3,4/5,6", "0:1,2/3,4/5")),
        (parse_ruler, ("0:1,2/3,4", "0:1,2/3,4/x", "1,2/3,4/5")),
        (parse_frame_distance, ("0,1", "a,b,1", "0,1,2,3")),
    ):
        for text in texts:
            refused("must be FRAME", parse, text)


@pytest.mark.slow
def test_frames_beyond_the_clip_and_resting_cameras_are_refused(tmp_path: Path) -> None:
    clip = write_clip(tmp_path / "clip.mkv", turning(9))
    refused("frames 0 to 8", matchmove_clip, clip, tmp_path / "work", MatchmoveSettings(distance=(0, 9, 1.0)))
    clip = write_clip(tmp_path / "resting.mkv", walking(9)[:1] * 4)
    refused("take a single camera", matchmove_clip, clip, tmp_path / "work")


def test_what_was_solved_outlives_settings_that_are_refused(tmp_path: Path) -> None:
    clip, kept = write_clip(tmp_path / "clip.mkv", walking(2)), tmp_path / "work" / "solve.json"
    key = clip_matchmove._key(clip, MatchmoveSettings())
    assert not begin_solving(kept.parent, key)
    kept.touch()
    refused("--mapper must be", matchmove_clip, clip, kept.parent, MatchmoveSettings(mapper="globel"))
    refused("--camera-model must be", matchmove_clip, clip, kept.parent, MatchmoveSettings(camera_model="radial"))
    assert kept.exists() and begin_solving(kept.parent, key)


@pytest.mark.slow
def test_a_walk_is_matchmoved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """25 frames, 8 keyframes. Way of 1.3 m; Measured: 0.8 mm, and 0.26 degrees, most of it
    from aligning by places that lie almost on a line."""
    pytest.importorskip("pycolmap")
    cameras = walking(25)
    clip = write_clip(tmp_path / "clip.mkv", cameras)
    told = printed_by(app, "matchmove", clip, "--out", tmp_path / "track.json", "--keyframes", 8)
    assert "25 of 25 frames" in told and "scale arbitrary" in told
    track = read_track(tmp_path / "track.json")
    off_m, off_deg = errors(cameras, track)
    assert off_m < 0.005 and off_deg < 0.5 and not track.metric
    assert track.at(0).camera.focal_px[0] == pytest.approx(380.0, rel=0.01) and track.at_time(0.52).camera.width_px == 400
    pixels = ["/".join(f"{x:.1f},{y:.1f}" for x, y in cameras[0].project(each)[0]) for each in (FLOOR_POINTS[:3], FLOOR_POINTS[:2])]
    true_m = float(np.linalg.norm(FLOOR_POINTS[1] - FLOOR_POINTS[0]))
    picks = ["--ground", f"0:{pixels[0]}", "--ruler", f"0:{pixels[1]}/{true_m}", "--overwrite"]
    monkeypatch.setattr(clip_matchmove, "_solved", lambda *_, **__: pytest.fail("solved again"))
    again = printed_by(app, "matchmove", clip, "--out", tmp_path / "track.json", "--keyframes", 8, *picks)
    assert "in metres, by --ruler" in again
    stands = read_track(tmp_path / "track.json")
    # Picks of 0.1 px on a floor seen from 0.8 m above: 2 mm, and what the model itself is off.
    heights_m = np.array([0.8 - camera.world_from_camera[1, 3] for camera in cameras])
    assert stands.metric and stands.up == "-z"
    assert [-stands.at(n).camera.world_from_camera[2, 3] for n in range(25)] == pytest.approx(heights_m, abs=0.01)
    refused("say with --ground", printed_by, app, "matchmove", clip, "--out", tmp_path / "track.json", "--keyframes", 8, *picks[2:])


@pytest.fixture(scope="module")
def solved_clip(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], ClipSolve]:
    """Give the solve of a real clip, made once."""

    @cache
    def solved(name: str) -> ClipSolve:
        pytest.importorskip("pycolmap")
        path = shared_data / "video" / name
        if not path.is_file():
            pytest.skip(f"video/{name} is not in the shared test data")
        return matchmove_clip(path, tmp_path_factory.mktemp("matchmove") / "work").solve

    return solved


ROLLING = (
    "since a plane seen face on goes before a tilted one, 74 %: the shutter rolls, which a plane tilted by 36 degrees through a lens of "
    "two and a half times the focal length takes for perspective, and explains 85 %"
)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "least_fitting"),
    [
        pytest.param("nikon_d90_chart.avi", 0.8, id="over-a-chart", marks=pytest.mark.xfail(strict=True, reason=ROLLING)),
        pytest.param("iphone_xr_chart.mov", 0.8, id="hardly-moving"),
        pytest.param("ducks_720p.mp4", 0.15, id="over-water"),
    ],
)
def test_most_of_what_rests_is_explained(solved_clip: Callable[[str], ClipSolve], name: str, least_fitting: float) -> None:
    """On the pond most of what is followed is water and ducks."""
    assert np.median([each.fitting for each in solved_clip(name).fits.values()]) > least_fitting


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [("nikon_d90_chart.avi", FLAT), ("iphone_xr_chart.mov", FLAT), ("ducks_720p.mp4", TURNING)])
def test_clips_that_hardly_move_are_solved(solved_clip: Callable[[str], ClipSolve], name: str, kind: str) -> None:
    """Real clips, all of whose frames come out within 1 px; both charts are seen face on."""
    solve = solved_clip(name)
    assert solve.kind == kind and solve.lost == () and solve.residual_px < 1.0
    if kind == FLAT:
        points, middle = solve.model.points, solve.model.views[len(solve.model.views) // 2].camera.camera_from_world
        normal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
        assert abs((middle[:3, :3] @ normal)[2]) > np.cos(np.radians(10.0))
