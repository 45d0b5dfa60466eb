"""CameraTrack: frames by number and by time, interpolation, axes and their picture; intrinsics of a camera that was held upright."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datasets_scripts.track_picture import axes_of, main, with_axes
from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.board_track import Intrinsics, intrinsics_of_clip
from mrbokeh.tracking.camera_track.formats import write_track
from mrbokeh.tracking.camera_track.track import DISTORTION_NAMES, CameraTrack, TrackedFrame, fixed_track
from mrbokeh.tracking.world_axes import UPRIGHT_FROM_WORLD, upright_camera
from tests.support.command_line import printed_by
from tests.support.refusals import refused
from tests.support.video_files import filmed


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


def test_halfway_a_panning_camera_stays_on_its_tripod_and_turns_the_short_way() -> None:
    """1 m and 3 m are 1 and 1/3 dioptre: halfway lies 2/3, 1.5 m. f/2 and f/8 are four stops apart: halfway lies f/4."""
    middle = two_frames().at_time(0.5)
    np.testing.assert_allclose(middle.camera.world_from_camera[:3, 3], (1.0, 2.0, 3.0), atol=1e-12)
    np.testing.assert_allclose(middle.camera.world_from_camera[:3, 2], (0.5, 0.0, np.sqrt(0.75)), atol=1e-12)
    assert middle.focus_distance_m == pytest.approx(1.5) and middle.f_number == pytest.approx(4.0) and middle.time_s == 0.5
    # From 170 to -170 degrees through 180, not through 0.
    one, other = (camera_at((0.0, 0.0, 0.0), Rotation.from_euler("y", angle, degrees=True)) for angle in (170.0, -170.0))
    middle = CameraTrack({0: TrackedFrame(one, time_s=0.0), 1: TrackedFrame(other, time_s=1.0)}).at_time(0.5)
    np.testing.assert_allclose(middle.camera.world_from_camera[:3, 2], (0.0, 0.0, -1.0), atol=1e-12)
    track = two_frames()
    for number, time_s in ((0, 0.0), (24, 1.0)):
        np.testing.assert_allclose(track.at_time(time_s).camera.camera_from_world, track.at(number).camera.camera_from_world, atol=1e-15)


def test_focus_comes_in_dioptres_and_what_one_frame_knows_is_not_made_up() -> None:
    frames = {n: replace(two_frames().at(0), focus_distance_m=d, time_s=float(n)) for n, d in ((0, float("inf")), (1, 2.0))}
    assert CameraTrack(frames).at_time(0.5).focus_distance_m == pytest.approx(4.0)
    track = two_frames()
    partly = replace(track, frames={**track.frames, 24: replace(track.at(24), f_number=None)})
    assert partly.at_time(0.25).f_number is None and partly.at_time(0.25).focus_distance_m is not None


def test_outside_its_times_and_frames_the_track_says_so() -> None:
    for time_s in (-0.001, 1.001):
        with pytest.raises(InputError, match=r"from 0.0000 s to 1.0000 s"):
            two_frames().at_time(time_s)
    with pytest.raises(InputError, match=r"frames 0 to 24 .but not all of them., not frame 7"):
        two_frames().at(7)


def test_times_follow_from_a_frame_rate_and_a_fixed_camera_stands_for_every_frame() -> None:
    timed = replace(two_frames(), frames={n: replace(f, time_s=None) for n, f in two_frames().frames.items()})
    refused("no times", timed.at_time, 0.5)
    assert timed.timed(48.0).at_time(0.5).time_s == 0.5
    assert timed.shifted(1001).numbers == [1001, 1025]
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
        refused(says, CameraTrack, frames, up)
    refused("lens distortion is given by k1", TrackedFrame, one.camera, distortion={"kappa": 0.1})


LEVEL = Intrinsics(Camera(640, 360, (600.0, 620.0), (330.0, 170.0)), {"k1": -0.1, "p1": 0.01, "p2": -0.02, "k3": 0.03})
POINTS_M = np.array([[0.1, -0.05, 1.0], [-0.2, 0.1, 1.0], [0.0, 0.15, 1.0], [0.25, 0.12, 1.0]])
CLIP = Path("clip.mov")


def seen_px(intrinsics: Intrinsics, points_m: np.ndarray) -> np.ndarray:
    """By OpenCV's model of a lens."""
    (fx, fy), (cx, cy) = intrinsics.camera.focal_px, intrinsics.camera.principal_px
    coefficients = np.array([(intrinsics.distortion or {}).get(name, 0.0) for name in DISTORTION_NAMES])
    matrix = np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])
    return cv2.projectPoints(points_m, np.zeros(3), np.zeros(3), matrix, coefficients)[0].reshape(-1, 2)


def turned_px(xy_px: np.ndarray, size_px: tuple[int, int], quarter_turns: int) -> np.ndarray:
    """Where numpy's rot90 brings places of a picture."""
    for _ in range(quarter_turns):
        xy_px, size_px = np.stack([xy_px[:, 1], size_px[0] - xy_px[:, 0]], axis=1), size_px[::-1]
    return xy_px


@pytest.mark.parametrize("quarter_turns", [0, 1, 2, 3])
def test_what_a_turned_camera_sees_is_what_the_level_one_saw_turned(quarter_turns: int) -> None:
    """y points down: pictures turned counter-clockwise are those of a camera that was turned clockwise."""
    size_px = (640, 360) if quarter_turns % 2 == 0 else (360, 640)
    found = intrinsics_of_clip(LEVEL, size_px, quarter_turns, CLIP)
    assert (found.camera.width_px, found.camera.height_px) == size_px
    turn = Rotation.from_euler("z", -90.0 * quarter_turns, degrees=True)
    if quarter_turns == 2:
        # Of the same shape: nobody can tell, and no lens is known that well.
        assert found.camera.principal_px == LEVEL.camera.principal_px
        found = LEVEL.turned(2)
    expected = turned_px(seen_px(LEVEL, POINTS_M), (640, 360), quarter_turns)
    np.testing.assert_allclose(seen_px(found, turn.apply(POINTS_M)), expected, atol=1e-6)


def test_another_size_of_the_same_shape_is_taken_and_another_shape_refused() -> None:
    picture = np.zeros((360, 640))
    picture[20, 600] = 1.0
    for turns in range(4):
        (row,), (column,) = np.nonzero(np.rot90(picture, turns))
        np.testing.assert_array_equal(turned_px(np.array([[600.5, 20.5]]), (640, 360), turns), [[column + 0.5, row + 0.5]])
    found = intrinsics_of_clip(LEVEL, (180, 320), 3, CLIP).camera
    assert found.focal_px == (310.0, 300.0)
    for size_px, turns in (((640, 480), 0), ((360, 640), 0), ((480, 640), 1)):
        refused(f"clip.mov .{size_px[0]}x{size_px[1]}., got those of 640x360", intrinsics_of_clip, LEVEL, size_px, turns, CLIP)


CAMERA = Camera(160, 112, (100.0, 100.0), (80.5, 56.5))


def drawn_axes(at_z_m: float, up: str) -> np.ndarray:
    return with_axes(np.zeros((112, 160, 3), np.uint8), CAMERA, axes_of(up, 0.4), np.array([0.0, 0.0, at_z_m]))


def test_axes_are_where_the_camera_sees_them_and_up_is_blue() -> None:
    """0.4 m to the right at 1 m is 40 px at a focal length of 100 px, and so is 0.4 m down; z runs towards the middle of the picture."""
    drawn = drawn_axes(1.0, "-z")
    assert drawn[56, 105].tolist() == [255, 40, 40] and drawn[85, 80].tolist() == [40, 220, 40]
    assert drawn[56, 80].tolist() == [60, 110, 255]
    assert drawn[56, 119:122].max() == 255 and not drawn[56, 123:].any(), "the side of the square, at 120.5"
    assert not drawn[:14].any() and drawn[16, 60:100, 0].min() > 100, "its upper side, at 16.5"
    # -y is up in the picture of a level camera.
    assert drawn_axes(2.0, "-y")[45, 80].tolist() == [60, 110, 255]
    assert not (drawn_axes(2.0, "+y")[:50, 80] == [60, 110, 255]).all(1).any()
    assert not drawn_axes(-1.0, "-z").any()


def test_the_command_shows_three_frames(tmp_path: Path) -> None:
    filmed(tmp_path / "clip.mkv", [np.full((112, 160, 3), 0.2, np.float32)] * 5)
    write_track(tmp_path / "track.json", fixed_track(CAMERA))
    words = [tmp_path / name for name in ("clip.mkv", "track.json", "track.png")]
    printed_by(main, *words, "--at", "0,0,1", "--size-m", "0.4")
    sheet = cv2.imread(str(words[2]))[..., ::-1]
    assert sheet.shape == (112, 480, 3)
    assert all(sheet[56, 105 + 160 * number].tolist() == [255, 40, 40] for number in range(3))
    assert np.abs(sheet[5, 5].astype(int) - 124).max() <= 2, "linear 0.2 is 124 of 255 in sRGB"
    assert "expected --at X,Y,Z" in printed_by(main, *words, "--at", "0,0", "--overwrite", exit_code=2)
