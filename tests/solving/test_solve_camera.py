"""The camera from one picture against pictures whose camera is known, and what is refused. The bars are those of the issue."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mrbokeh.images.image_io import write_image
from mrbokeh.scene.staging.scene_description import looking_down
from mrbokeh.solving import vanishing_points
from mrbokeh.solving.line_segments import find_segments, working_copy
from mrbokeh.solving.solve_camera import Line, solve_camera
from mrbokeh.solving.solved_camera import SolvedCamera, read_solved_camera, write_solved_camera
from mrbokeh.solving.vanishing_points import Frame, best_frames, candidates, fit
from mrbokeh.system.errors import InputError
from tests.support.command_line import mrbokeh
from tests.support.projected_places import KINDS, LENSES_MM, Place, place


@cache
def room() -> tuple[Place, np.ndarray]:
    """A room and its picture, which several tests take and none changes."""
    made = place("room", 101, 24.0)
    rgb = made.linear()
    rgb.flags.writeable = False
    return made, rgb


@cache
def camera_of_room(focal_px: float | None = None) -> SolvedCamera:
    """The camera of the room, for each focal length that is stated."""
    return solve_camera(room()[1], focal_px)


def horizon_off_deg(camera: SolvedCamera, made: Place) -> float:
    """Return the angle between the solved and the true direction down: of the horizon's plane."""
    return float(np.degrees(np.arccos(np.clip(camera.camera_from_world[:, 1] @ made.down, -1.0, 1.0))))


def in_pixels(made: Place, points_m: np.ndarray) -> np.ndarray:
    seen = np.asarray(points_m) @ made.camera_from_world.T
    return seen[:, :2] / seen[:, 2:] * made.focal_px + np.array([made.width_px, made.height_px]) / 2


@pytest.mark.parametrize(("kind", "seed"), [("room", 101), ("street", 102), ("table", 100)])
def test_a_picture_tells_its_camera(kind: str, seed: int) -> None:
    """Focal length within 3 %, horizon within 0.5 degrees, and no farther off than 4 standard deviations."""
    made = room()[0] if kind == "room" else place(kind, seed, 24.0)
    camera = camera_of_room() if kind == "room" else solve_camera(made.linear())
    off_px = abs(camera.focal_length_px - made.focal_px)
    assert camera.focal_length_source == "solved" and camera.confidence in ("high", "fair")
    assert off_px < 0.03 * made.focal_px and off_px < 4.0 * camera.focal_length_sd_px + 0.003 * made.focal_px
    assert horizon_off_deg(camera, made) < 0.5


@pytest.mark.slow
def test_nine_in_ten_of_forty_pictures() -> None:
    """36 of 40 pictures of rooms, streets and tables by three lenses."""
    right, told = 0, []
    for number in range(40):
        made = place(KINDS[number % 3], 2000 + number, LENSES_MM[number // 3 % 3])
        try:
            camera = solve_camera(made.linear())
        except InputError as error:
            told.append(f"{number}: {error}")
            continue
        off, off_deg = camera.focal_length_px / made.focal_px - 1.0, horizon_off_deg(camera, made)
        is_right = abs(off) < 0.03 and off_deg < 0.5
        right += is_right
        told += [] if is_right else [f"{number}: {off:+.1%}, {off_deg:.2f} degrees, {camera.confidence}"]
    assert right >= 36, told


def test_a_known_focal_length_is_kept_and_compared() -> None:
    made, _ = room()
    camera = camera_of_room(made.focal_px)
    assert camera.focal_length_px == made.focal_px and not camera.disagreement()
    assert horizon_off_deg(camera, made) < 0.3
    wrong = camera_of_room(1.3 * made.focal_px)
    assert "are stated" in wrong.disagreement()


def test_what_was_fitted_once_is_not_fitted_again_and_a_room_has_the_same_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    segments = find_segments(working_copy(room()[1]))
    points, fits = candidates(segments, np.random.default_rng(0)), [0]

    def counted(*args: Any) -> Frame:
        fits[0] += 1
        return fit(*args)

    monkeypatch.setattr(vanishing_points, "fit", counted)
    found, few = best_frames(segments, points), fits[0]
    refined = vanishing_points._refined
    forgetting = lambda segments, frame, focal, _fitted, start: refined(segments, frame, focal, {}, start)  # noqa: E731
    monkeypatch.setattr(vanishing_points, "_refined", forgetting)
    plain = best_frames(segments, points)
    assert few < 0.8 * (fits[0] - few)
    assert len(found) == len(plain)
    for one, other in zip(found, plain, strict=True):
        np.testing.assert_array_equal(one.axes, other.axes)
        np.testing.assert_allclose([*one.directions.ravel(), one.focal], [*other.directions.ravel(), other.focal], atol=1e-9)


def test_distortion_of_a_lens_does_not_bend_the_camera_and_a_fisheye_is_refused() -> None:
    """2 % in the corners, as cheap lenses have; and a fisheye's angle proportional to the distance from the middle."""
    made, rgb = room()
    corner_px = 0.5 * np.hypot(made.width_px, made.height_px)
    y, x = np.mgrid[: made.height_px, : made.width_px] + 0.5
    x, y = x - made.width_px / 2, y - made.height_px / 2
    radius = np.hypot(x, y)

    def seen(times: np.ndarray) -> np.ndarray:
        maps = (x * times + made.width_px / 2 - 0.5, y * times + made.height_px / 2 - 0.5)
        return cv2.remap(rgb, *(each.astype(np.float32) for each in maps), cv2.INTER_LINEAR)

    camera = solve_camera(seen(1.0 + 0.02 * (radius / corner_px) ** 2))
    assert abs(camera.focal_length_px / made.focal_px - 1.0) < 0.03 and camera.distortion_percent == pytest.approx(-2.0, abs=0.5)
    angle = radius / corner_px * np.arctan(corner_px / made.focal_px)
    with pytest.raises(InputError, match="fisheye"):
        solve_camera(seen(made.focal_px * np.tan(angle) / radius))


def test_lines_by_hand_are_enough() -> None:
    """Two edges of each direction, drawn on nothing, an eye 1.6 m above a floor."""
    made = Place(240.0, 300, 200, place("room", 3, width_px=30).camera_from_world, np.random.default_rng(0))
    empty = np.full((200, 300, 3), 0.2, np.float32)
    corner, far = np.array([-1.0, 0.6, 4.0]), np.array([1.0, -0.7, 5.0])
    lines = []
    for axis, step in (("x", [1.5, 0, 0]), ("y", [0, 1.2, 0]), ("z", [0, 0, 2.0])):
        for start in (corner, far):
            (x1, y1), (x2, y2) = in_pixels(made, np.array([start, start + step]))
            lines.append(Line((x1, y1, x2, y2), axis))
    camera = solve_camera(empty, lines=lines)
    assert abs(camera.focal_length_px / 240.0 - 1.0) < 0.03 and horizon_off_deg(camera, made) < 0.5
    assert np.degrees(np.arccos(np.clip(np.abs(camera.camera_from_world[:, 0] @ made.camera_from_world[:, 0]), 0, 1))) < 0.5
    known = solve_camera(empty, 240.0, lines=[lines[2], lines[3], lines[0]])
    assert horizon_off_deg(known, made) < 0.5
    upright = solve_camera(empty, 240.0, lines=lines[2:4])
    assert horizon_off_deg(upright, made) < 0.5 and any("no level lines" in each for each in upright.assumed)
    with pytest.raises(InputError, match=r"fit no camera|too little"):
        solve_camera(empty, lines=lines[:1])


@pytest.mark.parametrize(("down_deg", "roll_deg"), [(0.0, 0.0), (12.0, -7.0), (-20.0, 25.0)])
def test_a_horizon_alone_tells_how_the_camera_was_held(down_deg: float, roll_deg: float) -> None:
    """The horizon of a known camera, drawn from either end; without a focal length the tilt goes by the usual one."""
    turn = looking_down(np.radians(down_deg), np.radians(roll_deg)).T
    (x1, y1), (x2, y2) = replace(camera_of_room(), focal_length_px=1200.0, width_px=1500, height_px=1000, camera_from_world=turn).horizon_px
    empty = np.full((1000, 1500, 3), 0.2, np.float32)
    for ends in ((x1, y1, x2, y2), (x2, y2, x1, y1)):
        found = solve_camera(empty, 1200.0, [Line(ends, "h")])
        assert found.pitch_deg == pytest.approx(-down_deg, abs=1e-6) and found.roll_deg == pytest.approx(roll_deg, abs=1e-6)
        assert np.linalg.det(found.camera_from_world) == pytest.approx(1.0) and found.confidence == "high" and not found.assumed
    guessed = solve_camera(empty, lines=[Line((x1, y1, x2, y2), "h"), Line((1.0, 2.0, 3.0, 400.0), "y")])
    assert guessed.focal_length_source == "guessed" and guessed.roll_deg == pytest.approx(roll_deg, abs=2.0) and len(guessed.assumed) == 2


def test_the_ground_lies_where_it_is() -> None:
    """Depth along the axis, against rays that are cut with the plane 1.6 m below; and its height from one length on it."""
    made, _ = room()
    rotation = made.camera_from_world
    camera = SolvedCamera(1500, 1000, made.focal_px, "known", rotation).standing(1.6)
    depth_m = camera.ground_depth(100, 150)
    assert depth_m.shape == (100, 150) and depth_m.dtype == np.float32
    for row, column in ((99, 10), (80, 75), (70, 140)):
        ray = rotation.T @ [(column + 0.5 - 75) * 10 / made.focal_px, (row + 0.5 - 50) * 10 / made.focal_px, 1.0]
        assert depth_m[row, column] == pytest.approx(1.6 / ray[1], rel=1e-4)
    (_, left_px), (_, right_px) = camera.horizon_px
    assert np.isinf(depth_m[: int(min(left_px, right_px) / 10) - 1]).all()
    ends = in_pixels(made, np.array([[-0.5, 1.6, 4.0], [0.7, 1.6, 5.0]])).ravel()
    assert camera.with_length(tuple(ends), float(np.hypot(1.2, 1.0))).camera_height_m == pytest.approx(1.6, rel=1e-6)
    with pytest.raises(InputError, match="below the horizon"):
        camera.with_length((10.0, 0.0, 40.0, 0.0), 1.0)


@pytest.mark.parametrize(("down_deg", "roll_deg"), [(0.0, 0.0), (12.0, -7.0), (35.0, 5.0), (-6.0, 3.0)])
def test_a_person_of_known_height_tells_how_high_the_camera_stands(down_deg: float, roll_deg: float) -> None:
    """A pole of 1.75 m and one of 0.4 m, which ends below the horizon, on a floor 1.6 m below a pinhole, wherever they stand."""
    turn = looking_down(np.radians(down_deg), np.radians(roll_deg)).T
    made = Place(1200.0, 1500, 1000, turn, np.random.default_rng(0))
    camera = replace(camera_of_room(), focal_length_px=1200.0, width_px=1500, height_px=1000, camera_from_world=turn)
    for metres in (1.75, 0.4):
        for x_m, z_m in ((-1.2, 4.0), (0.0, 6.0), (2.0, 9.0)):
            foot, top = in_pixels(made, np.array([[x_m, 1.6, z_m], [x_m, 1.6 - metres, z_m]]))
            for ends in ((*foot, *top), (*top, *foot)):
                stands = camera.with_height(ends, metres)
                assert stands.camera_height_m == pytest.approx(1.6, rel=1e-9) and stands.camera_height_source == "known"
            sure = replace(camera, pitch_sd_deg=0.0)
            off_m, pointed = sure.height_off_m((*foot, *top), metres, upright=True), np.random.default_rng(0)
            drawn = [np.array([*foot, *top]) + pointed.normal(0.0, 2.0, 4) for _ in range(200)]
            found_m = [camera.with_height(tuple(each), metres).camera_height_m for each in drawn]
            assert off_m == pytest.approx(np.std(found_m), rel=0.25), "by hands that are two pixels off"
            assert replace(camera, pitch_sd_deg=2.0).height_off_m((*foot, *top), metres, upright=True) > off_m


def test_no_height_is_told_by_what_does_not_stand() -> None:
    camera = replace(camera_of_room(), focal_length_px=1200.0, width_px=1500, height_px=1000, camera_from_world=np.eye(3))
    for ends, why in (
        ((700, 400, 700, 100), "below the horizon"),
        ((700, 800, 700, 800), "above its foot"),
        ((0, 800, 1400, 800), "above its foot"),
    ):
        with pytest.raises(InputError, match=why):
            camera.with_height(ends, 1.7)
    with pytest.raises(InputError, match="above 0"):
        camera.with_height((700, 800, 700, 500), -1.0)


@pytest.mark.parametrize(
    ("picture", "words"),
    [
        (np.full((300, 400, 3), 0.3, np.float32), "0 of them"),
        (np.random.default_rng(0).uniform(0, 1, (600, 800, 3)).astype(np.float32), "straight edges"),
        (np.full((200, 900, 3), 0.3, np.float32), "panorama"),
    ],
)
def test_what_does_not_tell_is_refused_in_one_sentence(picture: np.ndarray, words: str) -> None:
    with pytest.raises(InputError, match=words):
        solve_camera(picture)


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 2, 3))])
def test_leaves_are_no_camera(seed: int) -> None:
    """300 short strokes that point anywhere: no seed may make a camera of them."""
    made = Place(1200.0, 1500, 1000, np.eye(3), np.random.default_rng(seed))
    made.speckle(300)
    with pytest.raises(InputError, match="--line"):
        solve_camera(made.linear())


def test_a_file_brings_the_camera_back(tmp_path: Path) -> None:
    camera = camera_of_room().standing(1.4).of_sensor(36.0)
    write_solved_camera(tmp_path / "camera.json", camera)
    back = read_solved_camera(tmp_path / "camera.json")
    assert back.camera_height_m == 1.4 and back.focal_length_mm == pytest.approx(camera.focal_length_mm)
    np.testing.assert_allclose(back.camera_from_world, camera.camera_from_world)
    np.testing.assert_array_equal(back.ground_depth(50, 75), camera.ground_depth(50, 75))
    (tmp_path / "other.json").write_text('{"width_px": 3}')
    with pytest.raises(InputError, match="lacks"):
        read_solved_camera(tmp_path / "other.json")


def test_the_command_writes_a_camera_and_its_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the room's photograph, which the other tests solve for the same focal lengths."""
    made, rgb = room()

    def solved_once(read: np.ndarray, focal_px: float | None, lines: Sequence[Line]) -> SolvedCamera:
        assert np.abs(read - rgb).max() < 1e-6 and not lines and focal_px in (None, pytest.approx(made.focal_px))
        return camera_of_room(focal_px)

    monkeypatch.setattr("mrbokeh.solving.solve_camera.solve_camera", solved_once)
    write_image(tmp_path / "room.png", rgb)
    out, grid = tmp_path / "camera.json", tmp_path / "grid.png"
    done = mrbokeh("capture", "solve", tmp_path / "room.png", "--out", out, "--picture", grid)
    assert done.returncode == 0, done.stderr
    assert "guessed: the camera stands 1.5 m" in done.stdout and "confidence: " in done.stdout
    assert abs(read_solved_camera(out).focal_length_px / made.focal_px - 1.0) < 0.03
    assert cv2.imread(str(grid)).shape == (made.height_px, made.width_px, 3)
    stated = ("--focal-length", 24, "--sensor-width", 36, "--height", 1.7, "--overwrite")
    done = mrbokeh("capture", "solve", tmp_path / "room.png", "--out", out, *stated)
    assert "(24 mm)" in done.stdout and "1.7 m above" in done.stdout
    # 1.75 m upright on a floor 1.6 m below, and 1 m along it, as the true camera sees them.
    for words, start, end in ((",1.75,y", [0.3, 1.6, 4.0], [0.3, -0.15, 4.0]), (",1", [-0.4, 1.6, 3.5], [0.6, 1.6, 3.5])):
        ends = ",".join(f"{each:.1f}" for each in in_pixels(made, np.array([start, end])).ravel())
        done = mrbokeh("capture", "solve", tmp_path / "room.png", "--out", out, "--length", ends + words, "--overwrite")
        assert done.returncode == 0 and re.search(r"the camera stands 1\.\d+ \+- 0\.\d+ m above the ground", done.stdout), (
            done.stdout + done.stderr
        )
        assert read_solved_camera(out).camera_height_m == pytest.approx(1.6, rel=0.04)
    for words, told in (
        (("--line", "1,2,3,4"), "--line must be"),
        (("--length", "1,2,3"), "--length must be"),
        (("--length", "700,900,700,950,1.7,z"), "--length must be"),
        (("--height", "1", "--length", "1,900,9,900,2"), "not both"),
        (("--focal-length", 24), "--sensor-width"),
        (("--height", "0"), "above 0"),
    ):
        done = mrbokeh("capture", "solve", tmp_path / "room.png", "--out", out, "--overwrite", *words)
        assert done.returncode == 2 and told in done.stderr, done.stderr
