"""CameraTrack: frames by number and by time, interpolation, axes. Numbers come from closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackedFrame, fixed_track
from mrbokeh.tracking.world_axes import UPRIGHT_FROM_WORLD, upright_camera


def camera_at(place_m: tuple[float, float, float], turn: Rotation) -> Camera:
    """turn: world from camera."""
    pose = np.eye(4)
    pose[:3, :3] = turn.as_matrix().T
    pose[:3, 3] = -pose[:3, :3] @ np.asarray(place_m)
    return Camera(640, 360, (500.0, 500.0), (320.0, 180.0), pose)


def two_frames() -> CameraTrack:
    """On a tripod at (1, 2, 3): it pans by 60 degrees and pulls focus from 1 m to 3 m within a second, f/2 to f/8."""
    one, other = (camera_at((1.0, 2.0, 3.0), Rotation.from_euler("y", angle, degrees=True)) for angle in (0.0, 60.0))
    return CameraTrack({0: TrackedFrame(one, 1.0, 2.0, 0.0), 24: TrackedFrame(other, 3.0, 8.0, 1.0)}, "-y")


def test_halfway_a_panning_camera_stays_on_its_tripod_and_has_turned_by_half() -> None:
    """1 m and 3 m are 1 and 1/3 dioptre: halfway lies 2/3, 1.5 m. f/2 and f/8 are four stops apart: halfway lies f/4."""
    middle = two_frames().at_time(0.5)
    np.testing.assert_allclose(middle.camera.world_from_camera[:3, 3], (1.0, 2.0, 3.0), atol=1e-12)
    np.testing.assert_allclose(middle.camera.world_from_camera[:3, 2], (0.5, 0.0, np.sqrt(0.75)), atol=1e-12)
    assert middle.focus_distance_m == pytest.approx(1.5) and middle.f_number == pytest.approx(4.0) and middle.time_s == 0.5


def test_at_its_own_times_the_track_gives_its_own_frames() -> None:
    track = two_frames()
    for number, time_s in ((0, 0.0), (24, 1.0)):
        np.testing.assert_allclose(track.at_time(time_s).camera.camera_from_world, track.at(number).camera.camera_from_world, atol=1e-15)


def test_rotations_go_the_short_way() -> None:
    """From 170 to -170 degrees through 180, not through 0."""
    one, other = (camera_at((0.0, 0.0, 0.0), Rotation.from_euler("y", angle, degrees=True)) for angle in (170.0, -170.0))
    middle = CameraTrack({0: TrackedFrame(one, time_s=0.0), 1: TrackedFrame(other, time_s=1.0)}).at_time(0.5)
    np.testing.assert_allclose(middle.camera.world_from_camera[:3, 2], (0.0, 0.0, -1.0), atol=1e-12)


def test_from_infinity_focus_comes_in_dioptres() -> None:
    frames = {n: replace(two_frames().at(0), focus_distance_m=d, time_s=float(n)) for n, d in ((0, float("inf")), (1, 2.0))}
    assert CameraTrack(frames).at_time(0.5).focus_distance_m == pytest.approx(4.0)


def test_what_only_one_frame_knows_is_not_made_up() -> None:
    track = two_frames()
    partly = replace(track, frames={**track.frames, 24: replace(track.at(24), f_number=None)})
    assert partly.at_time(0.25).f_number is None and partly.at_time(0.25).focus_distance_m is not None


@pytest.mark.parametrize("time_s", [-0.001, 1.001])
def test_outside_its_time_the_track_says_so(time_s: float) -> None:
    with pytest.raises(InputError, match=r"from 0.0000 s to 1.0000 s"):
        two_frames().at_time(time_s)


def test_frames_that_are_not_there_are_an_error() -> None:
    with pytest.raises(InputError, match=r"frames 0 to 24 .but not all of them., not frame 7"):
        two_frames().at(7)


def test_times_follow_from_a_frame_rate() -> None:
    timed = replace(two_frames(), frames={n: replace(f, time_s=None) for n, f in two_frames().frames.items()})
    with pytest.raises(InputError, match="no times"):
        timed.at_time(0.5)
    assert timed.timed(48.0).at_time(0.5).time_s == 0.5
    assert timed.shifted(1001).numbers == [1001, 1025]


def test_a_fixed_camera_stands_for_every_frame() -> None:
    track = fixed_track(camera_at((0.0, 0.0, -2.0), Rotation.identity()))
    assert track.at(999).camera is track.at(0).camera and track.at_time(1e6).camera is track.at(0).camera
    assert track.size_px == (640, 360) and track.resized(320, 180).at(5).camera.focal_px == (250.0, 250.0)


@pytest.mark.parametrize("up", list(UPRIGHT_FROM_WORLD))
def test_worlds_with_another_axis_up_hold_the_same_upright_camera(up: str) -> None:
    """Whatever axis points up, the camera in the upright world is the same; and nothing is mirrored."""
    track = two_frames()
    turned = track.with_up(up)
    for number in track.numbers:
        one, other = (upright_camera(each.at(number).camera, each.up).camera_from_world for each in (track, turned))
        np.testing.assert_allclose(one, other, atol=1e-12)
        assert np.linalg.det(turned.at(number).camera.camera_from_world[:3, :3]) == pytest.approx(1.0)


def test_tracks_that_cannot_be_are_refused() -> None:
    one = two_frames().at(0)
    mirrored = replace(one, camera=replace(one.camera, camera_from_world=np.diag([1.0, 1.0, -1.0, 1.0])))
    for frames, up, says in (
        ({}, "-y", "a frame at least"),
        ({0: one}, "y", "points up must be one of"),
        ({0: one, 1: replace(one, camera=one.camera.resized(64, 36))}, "-y", "need one size"),
        ({0: mirrored}, "-y", "a rotation and a shift"),
    ):
        with pytest.raises(InputError, match=says):
            CameraTrack(frames, up)
    with pytest.raises(InputError, match="lens distortion is given by k1"):
        TrackedFrame(one.camera, distortion={"kappa": 0.1})
