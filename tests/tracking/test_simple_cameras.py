"""Cameras that only turn and flat scenes: points projected by true cameras, with noise and with things that move; drawn clips."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from capture.cli import app
from capture.matchmove import clip_matchmove
from capture.matchmove.clip_solve import FLAT, TURNING, ClipSolve
from capture.matchmove.flow_tracks import FlowTracks
from capture.matchmove.ground import Horizon, parse_horizon, upright
from capture.matchmove.simple_cameras import Focal, SimpleCamera
from capture.matchmove.simple_solve import _focal_told, simple_solve
from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.camera_track.formats import read_track
from tests.support.command_line import printed_by
from tests.support.refusals import refused
from tests.support.textured_room import picture, room_camera
from tests.support.video_files import filmed

COUNT, FOCAL_PX = 24, 380.0


def turning(count: int = COUNT) -> list[Camera]:
    """On a tripod at one place, by 40 degrees, nodding by 3."""
    return [room_camera((0.0, 0.0, 0.0), (2.5 * t - 1.2, 0.15 * np.sin(7.0 * t), 3.0)) for t in np.linspace(0.0, 1.0, count)]


def before_a_wall(count: int = COUNT) -> list[Camera]:
    """1.6 m along a wall 3.5 m away, looking at it from -25 to 25 degrees."""
    return [
        room_camera((1.6 * t - 0.8, 0.3 * np.sin(5.0 * t), 0.0), (-1.0 * t + 0.5, 0.2 * np.cos(4.0 * t), 3.0))
        for t in np.linspace(0.0, 1.0, count)
    ]


def tracks_of(cameras: Sequence[Camera], points: np.ndarray, noise_px: float = 0.1, moving: float = 0.0) -> FlowTracks:
    """Where cameras see points. moving: the share of the points that wander off, each its own way, by up to 2 px a frame."""
    rng = np.random.default_rng(3)
    wandering = rng.uniform(-2.0, 2.0, (len(points), 2)) * (rng.random(len(points)) < moving)[:, None]
    frames, features, places = [], [], []
    for number, camera in enumerate(cameras):
        xy_px, depth = camera.project(points)
        xy_px = xy_px + number * wandering + rng.normal(0.0, noise_px, xy_px.shape)
        inside = np.flatnonzero((depth > 0) & (xy_px > 0).all(axis=1) & (xy_px < (camera.width_px, camera.height_px)).all(axis=1))
        frames.append(np.full(len(inside), number))
        features.append(inside)
        places.append(xy_px[inside])
    size_px = (cameras[0].width_px, cameras[0].height_px)
    return FlowTracks(
        frames=np.concatenate(frames),
        features=np.concatenate(features),
        xy_px=np.concatenate(places),
        size_px=size_px,
        frame_count=len(cameras),
    )


def room_points(count: int = 600) -> np.ndarray:
    """Somewhere in front, from 2 to 9 m away: a room of depth."""
    rng = np.random.default_rng(0)
    return rng.uniform((-5.0, -3.0, 2.0), (5.0, 3.0, 9.0), (count, 3))


def wall_points(count: int = 500) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.column_stack([rng.uniform(-3.0, 3.0, (count, 2)), np.full(count, 3.5)])


def solved(tracks: FlowTracks, focal: Focal | None = None) -> ClipSolve:
    found = simple_solve(
        tracks, range(0, tracks.frame_count, 2), focal or Focal(320.0), [number / 25.0 for number in range(tracks.frame_count)]
    )
    assert found is not None and found.usable
    return found.solve


def worst_turn_deg(cameras: Sequence[Camera], solve: ClipSolve) -> float:
    """Largest error of the rotation since the first frame."""
    relative = [
        [each[:3, :3] @ poses[0][:3, :3].T for each in poses]
        for poses in ([camera.camera_from_world for camera in cameras], [view.camera.camera_from_world for view in solve.model.views])
    ]
    return float(np.degrees(max(Rotation.from_matrix(one.T @ other).magnitude() for one, other in zip(*relative, strict=True))))


@pytest.mark.parametrize("moving", [0.0, 0.4])
def test_a_turning_camera_is_found_with_its_focal_length(moving: float) -> None:
    """Noise of 0.1 px over a pan of 40 degrees, from a guess that is 16 % short; 0.1 px are 0.015 degrees. With 40 % of what is seen adrift
    what rests is found, and 16 frames hold."""
    cameras = turning(16)
    solve = solved(tracks_of(cameras, room_points(500), moving=moving))
    assert solve.kind == TURNING and solve.lost == ()
    assert solve.model.views[0].camera.focal_px[0] == pytest.approx(FOCAL_PX, rel=0.01)
    assert worst_turn_deg(cameras, solve) < 0.1
    # The median length of two coordinates with noise of 0.1 px is 0.118.
    assert solve.residual_px == pytest.approx(0.118, rel=0.15)
    assert max(np.linalg.norm(view.centre) for view in solve.model.views) < 1e-9
    assert np.median([fit.fitting for fit in solve.fits.values()]) == pytest.approx(1.0 - moving, abs=0.08)


@pytest.mark.slow
@pytest.mark.parametrize("moving", [0.0, 0.25])
def test_a_flat_scene_is_found_with_focal_length_and_way(moving: float) -> None:
    """Seen from -25 to 25 degrees: the focal length to 2 %, the way of 1.6 m, at the unit that it is in, to 1 cm."""
    cameras = before_a_wall()
    solve = solved(tracks_of(cameras, wall_points(), moving=moving))
    assert solve.kind == FLAT and solve.lost == ()
    assert solve.model.views[0].camera.focal_px[0] == pytest.approx(FOCAL_PX, rel=0.02)
    assert worst_turn_deg(cameras, solve) < 0.5 and solve.residual_px == pytest.approx(0.118, rel=0.15)
    true_m = np.array([camera.world_from_camera[:3, 3] for camera in cameras])
    found = np.array([view.centre for view in solve.model.views])
    away = np.linalg.norm(true_m - true_m[0], axis=1), np.linalg.norm(found - found[0], axis=1)
    scale = float(away[0] @ away[1] / (away[1] @ away[1]))
    assert np.abs(scale * away[1] - away[0]).max() < 0.01


@pytest.mark.slow
def test_a_rolling_shutter_does_not_pass_for_a_tilt() -> None:
    """A camera that looks square at a wall and slides along it, up and down, read out over half a frame's time: rows shift by up to 2 px,
    which a wall tilted by 31 degrees fits to 0.17 px and the true one to 0.26."""
    times = np.linspace(-0.6, 0.6, COUNT)
    cameras = [room_camera((t, 0.1 * np.sin(9.0 * t), 0.0), (t + 0.02 * np.sin(5.0 * t), 0.1 * np.sin(9.0 * t), 3.0)) for t in times]
    tracks = tracks_of(cameras, wall_points())
    places = np.array([camera.world_from_camera[:2, 3] for camera in cameras])
    per_frame_px = -FOCAL_PX / 3.5 * np.gradient(places, axis=0)[tracks.frames]
    rolled = tracks.xy_px + 0.5 * (tracks.xy_px[:, 1:] / tracks.size_px[1] - 0.5) * per_frame_px
    solve = solved(replace(tracks, xy_px=rolled))
    middle, points = solve.model.views[COUNT // 2], solve.model.points
    normal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    assert solve.kind == FLAT and abs(middle.camera.camera_from_world[2, :3] @ normal) > np.cos(np.radians(3.0))


@pytest.mark.slow
def test_a_room_with_depth_is_left_to_colmap() -> None:
    """Walked through, neither simple camera explains it; a stated focal length is kept to the pixel."""
    walking = [room_camera((-0.8 + 1.2 * t, 0.1 * np.sin(6 * t), -0.3 + 0.4 * t), (0.2, 0.05, 3.0)) for t in np.linspace(0.0, 1.0, COUNT)]
    tracks = tracks_of(walking, room_points())
    found = simple_solve(tracks, range(0, COUNT, 2), Focal(320.0), np.arange(COUNT) / 25.0)
    assert found is None or not found.explains
    stated = solved(tracks_of(turning(), room_points()), Focal(FOCAL_PX, 0.0))
    assert stated.model.views[0].camera.focal_px[0] == pytest.approx(FOCAL_PX, rel=1e-4) and "as stated" in stated.why


def test_a_turning_camera_stands_over_the_ground_that_its_horizon_tells() -> None:
    """The cameras are level in their room, so that its horizon is y = 0 far away: two directions 30 degrees apart."""
    cameras = turning()
    solve = solved(tracks_of(cameras, room_points()), Focal(FOCAL_PX, 0.0))
    far = cameras[0].project(1e6 * np.array([[-0.5, 0.0, 1.0], [0.05, 0.0, 1.0]]))[0]
    model, assumed = upright(solve, Horizon(0, far), None, 1.7)
    assert assumed == () and model.metres_per_unit == 1.0
    for view, camera in zip(model.views, cameras, strict=True):
        assert view.centre[1] == pytest.approx(-1.7)
        down = [each.camera_from_world[:3, 1] for each in (view.camera, camera)]
        assert np.degrees(np.arccos(np.clip(down[0] @ down[1], -1.0, 1.0))) < 0.1
    # Without them both are guessed, and said.
    assert len(upright(solve, None, None, None)[1]) == 2
    refused("must differ", upright, solve, Horizon(0, np.array([[3.0, 4.0], [3.0, 4.0]])), None, None)
    for text in ("", "0", "0:1,2", "0:1,2/3", "x:1,2/3,4"):
        refused("must be FRAME", parse_horizon, text)


def test_a_drawn_pan_is_solved_once_and_stood_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """10 drawn frames of a pan by 40 degrees. The second run of the same command, with another height, solves nothing."""
    cameras = [camera.resized(320, 240) for camera in turning(10)]
    light = ((picture(camera).astype(np.float32) / 255.0) ** 2.2 for camera in cameras)
    clip = filmed(tmp_path / "clip.mkv", (np.repeat(each[..., None], 3, axis=2).astype(np.float32) for each in light), 24)
    out = tmp_path / "track.json"
    told = printed_by(app, "matchmove", clip, "--out", out)
    assert "a camera that only turns" in told and "10 of 10 frames" in told and "--camera-height" in told and "scale arbitrary" in told
    track = read_track(out)
    assert track.up == "-z" and track.at(0).camera.focal_px[0] == pytest.approx(0.8 * FOCAL_PX, rel=0.02)
    turn = track.at(9).camera.camera_from_world[:3, :3] @ track.at(0).camera.camera_from_world[:3, :3].T
    true = cameras[9].camera_from_world[:3, :3] @ cameras[0].camera_from_world[:3, :3].T
    assert np.degrees(Rotation.from_matrix(turn.T @ true).magnitude()) < 0.5
    monkeypatch.setattr(clip_matchmove, "_solved", lambda *_, **__: pytest.fail("solved again"))
    again = printed_by(app, "matchmove", clip, "--out", out, "--camera-height", 2.0, "--overwrite")
    assert "in metres, by --camera-height" in again
    heights = [-read_track(out).at(number).camera.world_from_camera[2, 3] for number in range(10)]
    assert heights == pytest.approx([2.0] * 10)
    before = out.read_bytes()
    outside = ("--ground", "0:100,200/600,200/240,220", "--overwrite")
    refused("600,200/240,220 lies outside", printed_by, app, "matchmove", clip, "--out", out, *outside)
    assert out.read_bytes() == before
    refused("sees no lengths", printed_by, app, "matchmove", clip, "--out", out, "--distance", "0,3,1", "--overwrite")
    with pytest.raises(BaseException, match="solved again"):
        printed_by(app, "matchmove", clip, "--out", out, "--focal-length", 40, "--overwrite")


def test_the_focal_length_that_a_phone_writes_is_taken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """26 mm on the diagonal of full frame (43.27 mm) are 300.4 px on that of 400x300 px."""
    clip = filmed(tmp_path / "clip.mov", [np.full((300, 400, 3), 0.2, np.float32)] * 2, 24)
    info = clip_matchmove.probe(clip)
    assert clip_matchmove.stated_focal(clip, info, None).px == pytest.approx(28.0 / 36.0 * 400.0)
    known = clip_matchmove.stated_focal(clip, info, 26.0)
    assert (known.px, known.sigma) == (pytest.approx(300.4, abs=0.1), 0.0)
    monkeypatch.setattr(clip_matchmove, "_focal_in_file_mm", lambda _: 26.0)
    told = clip_matchmove.stated_focal(clip, info, None)
    assert told == replace(known, sigma=0.1)


def test_a_guessed_focal_length_names_the_option_that_settles_it() -> None:
    camera = SimpleCamera(TURNING, 900.0, 0.0, np.eye(4)[None], np.zeros((1, 3)), np.zeros((1, 2, 3)), focal_sigma=0.34)
    assert _focal_told(camera, Focal(900.0)).endswith("900 px +- 34 %, hardly told by the clip and in part guessed (--focal-length MM)")
