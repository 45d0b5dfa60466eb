"""Level ground of a photograph without depth: where objects stand, by a known camera, by straight lines, and where nothing tells."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.commands._composite_options import ObjectOptions
from mrbokeh.commands._level_ground import focused_on_foot, held_told, on_level_ground, sun_by_shadow, with_camera_of_file
from mrbokeh.compositing.plate import Plate, plate_of
from mrbokeh.optics.lens import Lens
from mrbokeh.scene.staging.scene_description import looking_down
from mrbokeh.solving.solved_camera import SolvedCamera, write_solved_camera
from mrbokeh.system.errors import InputError
from tests.support.projected_places import place

LENS = Lens(focal_length_mm=35.0, f_number=4.0, focus_distance_m=float("inf"), sensor_width_mm=36.0)
FOOT = ObjectOptions(object_=[Path("cake.glb")], at_pixel=["500,450"], height=["50px"])


def photograph(focus_m: float = float("inf"), **known: bool) -> Plate:
    """Return a picture of nothing, of 800x600 px, whose focal length is 777.8 px."""
    return replace(plate_of(np.full((600, 800, 3), 0.2, np.float32), LENS.focused_at(focus_m)), **known)


def place_m(standing: ObjectOptions, number: int = 0) -> np.ndarray:
    assert standing.at is not None
    return np.array([float(each) for each in standing.at[number].split(",")])


@pytest.mark.parametrize("pitch_deg", [0.0, 20.0])
def test_an_object_stands_as_far_below_the_camera_as_the_camera_is_high(pitch_deg: float) -> None:
    plate, standing = on_level_ground(photograph(), replace(FOOT, pitch=pitch_deg, camera_height=1.6))
    foot_m = place_m(standing)
    np.testing.assert_allclose(plate.camera.project(foot_m[None])[0][0], (500.0, 450.0), atol=1e-3)
    assert (looking_down(np.radians(pitch_deg)) @ foot_m)[1] == pytest.approx(1.6)


@pytest.mark.parametrize("known", ["both told", "tilt known", "roll known"])
def test_a_camera_that_is_turned_clockwise_sees_the_ground_fall_to_the_left(known: str) -> None:
    """A foot 1.6 m below the camera, 0.8 m to the right and 5 m ahead, seen by a camera that looks down by 12 degrees, turned by 7."""
    turn, foot_m = looking_down(np.radians(12.0), np.radians(7.0)), np.array([0.8, 1.6, 5.0])
    pixel = ",".join(f"{each:.9g}" for each in photograph().camera.project((turn.T @ foot_m)[None])[0][0])
    plate = {
        "both told": photograph(),
        "tilt known": replace(photograph(), world_from_camera=looking_down(np.radians(12.0), np.radians(-3.0))),
        "roll known": replace(photograph(), world_from_camera=looking_down(np.radians(1.0), np.radians(7.0))),
    }[known]
    told = {"both told": {"pitch": 12.0, "roll": 7.0}, "tilt known": {"roll": 7.0}, "roll known": {"pitch": 12.0}}[known]
    plate, standing = on_level_ground(plate, replace(FOOT, at_pixel=[pixel], camera_height=1.6, **told))
    np.testing.assert_allclose(turn @ place_m(standing), foot_m, atol=1e-6)
    np.testing.assert_allclose(plate.world_from_camera, turn, atol=1e-9)


def test_the_focus_tells_the_distance_unless_the_camera_would_float() -> None:
    """Ground 12.1 m away at that pixel is 2.2 m below a level camera: 150 px over a focal length of 777.8 px, and so many metres."""
    _, standing = on_level_ground(photograph(12.1), replace(FOOT, pitch=0.0))
    assert place_m(standing)[2] == pytest.approx(12.1)
    _, standing = on_level_ground(photograph(90.0), replace(FOOT, pitch=0.0))  # 17 m
    assert place_m(standing)[2] == pytest.approx(1.5 * plate_focal_px() / 150.0, rel=1e-3)


@pytest.mark.parametrize(("roll_deg", "told"), [(3.0, "clockwise"), (-0.7, "anticlockwise")])
def test_the_way_that_a_camera_is_turned_is_told(roll_deg: float, told: str) -> None:
    """The horizon of a camera turned clockwise rises to the right: the photograph shows it turned the other way."""
    world_from_camera = looking_down(np.radians(10.0), np.radians(roll_deg))
    assert held_told(world_from_camera) == f"looks down by 10 degrees, turned {told} by {abs(roll_deg):.1f} degrees"
    far_m = np.array([[-3.0, 0.0, 9.0], [3.0, 0.0, 9.0]]) @ world_from_camera
    left_px, right_px = photograph().camera.project(far_m)[0]
    assert (right_px[1] < left_px[1]) == (told == "clockwise")


def test_a_rough_focus_gives_way_to_a_camera_in_the_hand(capsys: pytest.CaptureFixture[str]) -> None:
    """A zone of 1.4 m to infinity allows 1.5 m of height, which is 8.1 m away at that pixel; one of 1.4 to 3 m does not."""
    rough = replace(photograph(5.0), rough_focus_m=(1.4, float("inf")))
    plate, standing = on_level_ground(rough, replace(FOOT, pitch=0.0))
    expected_m = 1.5 * rough.camera.focal_px[1] / 150.0
    assert place_m(standing)[2] == pytest.approx(expected_m)
    assert plate.lens.focus_distance_m == pytest.approx(expected_m)
    assert "focused on the object: the photograph tells a focus beyond 1.4 m (--focus METRES)" in capsys.readouterr().out
    on_level_ground(replace(rough, rough_focus_m=(1.4, 20.0)), replace(FOOT, pitch=0.0))
    assert "the photograph tells a focus between 1.4 and 20 m" in capsys.readouterr().out
    plate, standing = on_level_ground(replace(rough, rough_focus_m=(1.4, 6.0)), replace(FOOT, pitch=0.0))
    assert place_m(standing)[2] == plate.lens.focus_distance_m == pytest.approx(5.0)


def test_with_depth_the_focus_is_on_the_foot_where_nothing_tells_it() -> None:
    deep = replace(photograph(), depth_m=np.full((600, 800), 2.5, np.float32), focus_known=False)
    assert focused_on_foot(deep, FOOT).lens.focus_distance_m == pytest.approx(2.5)
    assert focused_on_foot(replace(deep, focus_known=True), FOOT).lens.focus_distance_m == float("inf")


def plate_focal_px() -> float:
    return float(photograph().camera.focal_px[1])


@pytest.mark.parametrize(("focus_m", "row", "below_deg"), [(float("inf"), 300, 10.0), (4.8, 300, 14.48), (1.0, 300, 30.0)])
def test_where_nothing_tells_ground_lies_as_deep_as_it_usually_does(focus_m: float, row: int, below_deg: float) -> None:
    """In the middle of the picture, where no ground is seen by a level camera: 1.2 m at 4.8 m are 14.5 degrees, half of 1 m is 30."""
    plate, standing = on_level_ground(photograph(focus_m, focus_known=focus_m < float("inf")), replace(FOOT, at_pixel=[f"400,{row}"]))
    assert plate.world_from_camera is not None
    foot_m = plate.world_from_camera @ place_m(standing)
    assert np.degrees(np.arctan2(foot_m[1], foot_m[2])) == pytest.approx(below_deg, abs=0.01)
    if not np.isfinite(focus_m):
        assert plate.lens.focus_distance_m == pytest.approx(place_m(standing)[2])


@pytest.mark.parametrize(("rows", "down_deg"), [(240, 4.41), (390, -6.6), (60, 0.0), (20, 0.0)])
def test_blue_sky_ends_no_lower_than_the_horizon(rows: int, down_deg: float) -> None:
    """With ground 30 px below the end of the sky, a horizon 10 degrees above that ground would lie in the sky. A horizon 60 px over the
    middle is 4.4 degrees, one 90 px below it is looking up; little sky tells nothing, and ground in row 450 is 11 degrees below a level
    view, which is enough.
    """
    rgb = np.random.default_rng(1).uniform(0.15, 0.25, (600, 800, 3)).astype(np.float32)
    rgb[:rows] = np.linspace(0.6, 0.9, rows, dtype=np.float32)[:, None, None] * np.float32([0.3, 0.5, 0.9])
    rgb[:, 700:] = 0.1  # a tower
    standing = replace(FOOT, at_pixel=[f"400,{rows + 30 if down_deg else 450}"])
    plate, _ = on_level_ground(replace(photograph(focus_known=False), rgb=rgb), standing)
    assert plate.world_from_camera is not None
    found_deg = np.degrees(np.arcsin(plate.world_from_camera[1, 2]))
    assert found_deg == pytest.approx(down_deg, abs=0.3)
    if down_deg:
        with pytest.raises(InputError, match="above the horizon"):
            on_level_ground(replace(photograph(focus_known=False), rgb=rgb), replace(FOOT, at_pixel=[f"400,{rows - 10}"]))


def test_straight_lines_tell_how_the_camera_was_held_and_its_field_of_view() -> None:
    made = place("room", 101, 24.0)
    rgb = made.linear()
    guessed = replace(plate_of(rgb, LENS), view_known=False, focus_known=False)
    plate, standing = on_level_ground(guessed, replace(FOOT, at_pixel=["700,900"]))
    assert plate.camera.focal_px[0] == pytest.approx(made.focal_px, rel=0.03)
    assert plate.lens.focal_length_mm == pytest.approx(24.0, rel=0.03)
    assert plate.world_from_camera is not None
    off_deg = np.degrees(np.arccos(np.clip(plate.world_from_camera[1] @ made.down, -1.0, 1.0)))
    assert off_deg < 0.5
    assert abs(float(plate.world_from_camera[0] @ [0.0, 0.0, 1.0])) < 1e-9, "z of the world is where the camera looks"
    assert float(made.down @ place_m(standing)) == pytest.approx(1.5, rel=0.02)


def test_a_solved_camera_of_a_file_comes_first(tmp_path: Path) -> None:
    solved = SolvedCamera(400, 300, 500.0, "solved", looking_down(0.2, 0.03).T, confidence="high").standing(1.2)
    write_solved_camera(tmp_path / "camera.json", solved)
    plate, height_m = with_camera_of_file(photograph(view_known=False), tmp_path / "camera.json")
    assert height_m == 1.2
    assert plate.camera.focal_px == pytest.approx((1000.0, 1000.0))
    np.testing.assert_allclose(plate.world_from_camera, looking_down(0.2, 0.03), atol=1e-12)
    _, standing = on_level_ground(plate, FOOT, height_m)
    assert (looking_down(0.2, 0.03) @ place_m(standing))[1] == pytest.approx(1.2)
    write_solved_camera(tmp_path / "other.json", replace(solved, height_px=400))
    with pytest.raises(InputError, match="400x400 px, but the photograph has 800x600"):
        with_camera_of_file(photograph(), tmp_path / "other.json")


@pytest.mark.parametrize(("change", "words"), [
    ({"pitch": 0.0, "at_pixel": ["500,250"]}, "above the horizon of a camera that looks down by 0 degrees"),
    ({"at_pixel": ["900,250"]}, "outside the photograph of 800x600 px"),
])  # fmt: skip
def test_a_pixel_without_ground_is_refused(change: dict[str, object], words: str) -> None:
    with pytest.raises(InputError, match=words):
        on_level_ground(photograph(), replace(FOOT, **change))


@pytest.mark.parametrize(("right_deg", "above_deg"), [(-60.0, 40.0), (35.0, 15.0), (170.0, 55.0), (-10.0, 70.0)])
@pytest.mark.parametrize(("down_deg", "roll_deg", "ahead_m"), [(0.0, 0.0, 6.0), (25.0, -8.0, 6.0), (0.0, 0.0, 2.6)])
def test_a_shadow_tells_where_the_sun_is(right_deg: float, above_deg: float, down_deg: float, roll_deg: float, ahead_m: float) -> None:
    """A post of 0.5 m in front of a camera 1.5 m high; its shadow ends where the sun's ray through its top meets the ground.

    At 2.6 m the ground lies below the frame.
    """
    plate = replace(photograph(), world_from_camera=looking_down(np.radians(down_deg), np.radians(roll_deg)))
    right, above = np.radians([right_deg, above_deg])
    towards = np.array([np.sin(right) * np.cos(above), -np.sin(above), np.cos(right) * np.cos(above)])
    foot, top = np.array([0.3, 1.5, ahead_m]), np.array([0.3, 1.0, ahead_m])
    tip = top + towards * (1.5 - top[1]) / towards[1]
    pixels, _ = plate.camera.project(np.array([top, foot, tip]) @ plate.world_from_camera)
    assert (pixels[1, 1] > plate.rgb.shape[0]) == (ahead_m < 6.0)
    told = sun_by_shadow(plate, *((float(x), float(y)) for x, y in pixels))
    np.testing.assert_allclose([float(each) for each in told.split(",")], (right_deg, above_deg), atol=0.01)


@pytest.mark.parametrize(
    ("pixels", "words"),
    [
        (((400, 200), (400, 250), (500, 450)), "the foot lies above the horizon"),
        (((400, 200), (400, 450), (500, 299)), "the shadow's tip lies above the horizon"),
        (((400, 550), (400, 450), (500, 500)), "the top is not above the ground"),
        (((400, 200), (400, 450), (3900, 500)), "far outside"),
        (((400, 200), (400, 450), (402, 451)), "are the same place"),
    ],
)
def test_pixels_that_are_no_shadow_are_refused(pixels: tuple[tuple[float, float], ...], words: str) -> None:
    with pytest.raises(InputError, match=words):
        sun_by_shadow(photograph(), *pixels)
