"""Several objects in one picture of `mrbokeh composite`: each at its own place and height, hiding and darkening one another."""

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.commands._composite_layers import layers_by, objects_apart, objects_of
from mrbokeh.commands._composite_options import CompositeOptions, ObjectOptions
from mrbokeh.commands._composited import hidden_warning, placed
from mrbokeh.commands._level_ground import on_level_ground
from mrbokeh.compositing.plate import Plate, plate_of
from mrbokeh.demo.plan import DATA
from mrbokeh.images.image_io import write_image
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.scene.staging.scene_description import looking_down
from mrbokeh.system.errors import InputError
from tests.support.command_line import mrbokeh

LENS = Lens(focal_length_mm=36.0, f_number=4.0, focus_distance_m=4.0, sensor_width_mm=36.0)
CAKE, ALIEN = DATA / "objects" / "cakeBirthday.glb", DATA / "objects" / "alien.glb"
WIDTH, HEIGHT = 360, 240
"""Seen with a focal length of 360 px."""
LEVEL = ObjectOptions(pitch=0.0, camera_height=1.0, height=["0.4"])


def photograph() -> Plate:
    return plate_of(np.full((HEIGHT, WIDTH, 3), 0.3, np.float32), LENS)


def on_ground(*objects: tuple[Path, str], plate: Plate | None = None, **more: object) -> tuple[CompositeOptions, Plate]:
    """Return options and plate of objects on pixels, 1 m below a level camera where there is no depth."""
    standing = replace(LEVEL, object_=[glb for glb, _ in objects], at_pixel=[at for _, at in objects], **more)
    found, options = placed(plate or photograph(), CompositeOptions(Path("photo.exr"), standing=standing))
    return options, found


def layers(*objects: tuple[Path, str], plate: Plate | None = None, **more: object) -> list[Layer]:
    """Return what `filmed` does, which is kept where there is no depth."""
    return filmed(*objects, **more) if plate is None else layers_by(*on_ground(*objects, plate=plate, **more))(plate)


@cache
def filmed(*objects: tuple[Path, str], **more: object) -> list[Layer]:
    options, plate = on_ground(*objects, **more)
    return layers_by(options, plate)(plate)


def rows_of(layer: Layer) -> tuple[int, int]:
    rows = np.nonzero(layer.alpha > 0.5)[0]
    return int(rows.min()), int(rows.max())


LEFT, RIGHT = (ALIEN, "80,200"), (CAKE, "280,180")


def test_apart_from_one_another_each_is_as_if_alone() -> None:
    """Objects are the same but for the rounding of their corners; light on the ground is drawn from other samples."""
    both, left, right = layers(LEFT, RIGHT), layers(LEFT), layers(RIGHT)
    np.testing.assert_allclose(both[0].alpha, left[0].alpha + right[0].alpha, atol=2e-3)
    for alone, seen in ((left, np.s_[:, :150]), (right, np.s_[:, 210:])):
        np.testing.assert_allclose(both[0].depth_m[seen], alone[0].depth_m[seen], rtol=1e-4)
        off = np.abs(both[1].alpha[seen] - alone[1].alpha[seen])
        assert off.mean() < 2e-3 and np.quantile(off, 0.999) < 0.1 and alone[1].alpha[seen].max() > 0.3
    np.testing.assert_allclose(both[0].rgb[:, :150], left[0].rgb[:, :150], atol=0.02)


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_hides_the_farther_whichever_is_given_first(order: int) -> None:
    """1 m below a level camera, rows 80 and 50 px under the horizon are 360 / 80 = 4.5 m and 7.2 m away."""
    near, far = (ALIEN, "180,200"), (CAKE, "180,170")
    both = layers(*(near, far)[::order], shadow=0.0)[0]
    alone = layers(near, shadow=0.0)[0]
    covered = alone.alpha > 0.999
    np.testing.assert_allclose(both.depth_m[covered], alone.depth_m[covered], rtol=1e-4)
    beside = (layers(far, shadow=0.0)[0].alpha > 0.999) & (alone.alpha == 0.0)
    assert beside.sum() > 200 and both.depth_m[covered].max() < 5.5 < both.depth_m[beside].min()


def test_each_has_its_own_pixel_and_height() -> None:
    """0.4 m at 4.5 m are 32 px and 0.8 m at 6 m are 48 px; the base in front of the middle lies a few rows lower."""
    options, plate = on_ground(LEFT, (ALIEN, "280,180"), height=["0.4", "0.8"], turn=[0.0, 90.0], shadow=0.0)
    sharp = layers_by(options, plate)(plate)
    for one, foot_px, high_px in zip(objects_apart(options, plate, sharp), ((80, 200), (280, 180)), (32, 48), strict=True):
        top, bottom = rows_of(one)
        assert abs(np.nonzero(one.alpha > 0.5)[1].mean() - foot_px[0]) < 3
        assert foot_px[1] - 1 <= bottom <= foot_px[1] + 0.15 * high_px and bottom - top == pytest.approx(high_px, rel=0.15)
        assert not (one.alpha - sharp[0].alpha > 2e-3).any(), "nothing hides them"


@pytest.mark.parametrize("pitch_deg", [0.0, 15.0])
def test_all_feet_lie_as_deep_below_the_camera_as_the_ground_of_the_first(pitch_deg: float) -> None:
    plate, standing = on_level_ground(photograph(), replace(LEVEL, object_=[CAKE, ALIEN], at_pixel=["80,200", "280,150"], pitch=pitch_deg))
    assert standing.at is not None
    feet_m = np.array([[float(each) for each in at.split(",")] for at in standing.at])
    np.testing.assert_allclose(feet_m @ looking_down(np.radians(pitch_deg))[1], 1.0, rtol=1e-6)
    np.testing.assert_allclose(plate.camera.project(feet_m)[0], [(80.0, 200.0), (280.0, 150.0)], atol=1e-3)


def test_one_shadow_falls_on_the_other() -> None:
    """The sun shines from the left, 20 degrees high: 0.4 m throw 1.1 m of shadow; the alien 0.5 m to the right is darker for the cake."""
    light = {"sun": "-90,20", "exposure": 1.0, "shadow": 0.0}
    alone, both = (layers(*objects, **light)[0] for objects in ([(ALIEN, "200,200")], [(ALIEN, "200,200"), (CAKE, "155,200")]))
    seen = (alone.alpha > 0.999) & np.isclose(both.depth_m, alone.depth_m, atol=1e-3)
    left = both.rgb[seen] / alone.rgb[seen]
    assert (left < 0.8).mean() > 0.05 and np.quantile(left, 0.99) < 1.05


def table(far_m: float) -> Plate:
    """Return a photograph of level ground 1 m below the camera, whose right half is nearer or farther by a share."""
    rows = np.maximum(np.arange(HEIGHT) + 0.5 - HEIGHT / 2, 1.0)
    depth_m = np.repeat((360.0 / rows)[:, None], WIDTH, axis=1).astype(np.float32)
    depth_m[:, WIDTH // 2 :] *= far_m
    return replace(photograph(), depth_m=depth_m, focus_known=True)


@pytest.mark.parametrize(("far_m", "grounds"), [(1.0, 1), pytest.param(1.03, 1, marks=pytest.mark.slow), (0.6, 2)])
def test_what_stands_on_another_level_has_its_own_ground(far_m: float, grounds: int) -> None:
    """Depth that is off by 3 % is the same table, one at 0.6 of it lies higher: each level has one shadow, and none has two.

    On the same table the object is larger by 3 %, and its shadow with it.
    """
    objects, *caught = layers(LEFT, RIGHT, plate=table(far_m), camera_height=None)
    assert len(caught) == grounds
    alone = layers(RIGHT, plate=table(far_m), camera_height=None)
    right = np.s_[:, 210:]
    np.testing.assert_allclose(objects.alpha[right].sum(), alone[0].alpha[right].sum(), rtol=0.08)
    dark = 1.0 - np.prod([1.0 - each.alpha[right] for each in caught], axis=0)
    larger = objects.alpha[right].sum() / alone[0].alpha[right].sum()
    assert dark.sum() == pytest.approx(larger * alone[1].alpha[right].sum(), rel=0.1)


def test_heights_in_pixels_hold_for_an_object_that_is_moved_to_the_level_of_the_first() -> None:
    """Both share row 200, so that both are 60 px high where they stand, though the depth of the second is off by 3 %."""
    standing = replace(LEVEL, object_=[CAKE, CAKE], at_pixel=["80,200", "280,200"], height=["60px"], camera_height=None)
    plate, options = placed(table(1.03), CompositeOptions(Path("photo.exr"), standing=standing))
    first, second = objects_of(options.standing, plate)
    assert second.stands_at_m[2] == pytest.approx(first.stands_at_m[2])
    assert second.height_m == pytest.approx(first.height_m)


def test_a_foot_on_what_has_no_detail_is_told(capsys: pytest.CaptureFixture[str]) -> None:
    """The right half has detail; 25 px to the left of it none of a foot's surroundings told its depth."""
    confidence = np.zeros((HEIGHT, WIDTH), np.float32)
    confidence[:, WIDTH // 2 :] = 0.5
    plate = replace(table(1.0), depth_confidence=confidence)
    for at_px, told in ((f"{WIDTH // 2 - 25},200", True), (f"{WIDTH // 2 - 10},200", False), ("280,200", False)):
        standing = replace(LEVEL, object_=[CAKE], at_pixel=[at_px], camera_height=None)
        objects_of(standing, plate)
        assert ("nothing near --at-pixel told its depth" in capsys.readouterr().out) == told


def test_holes_of_guessed_depth_are_told() -> None:
    """A near block that nothing tells hides a quarter of what is put in; told by focus, it is no matter."""
    alpha = np.zeros((HEIGHT, WIDTH), np.float32)
    alpha[100:140, 100:140] = 1.0
    card = Layer(np.zeros((HEIGHT, WIDTH, 3), np.float32), alpha, np.where(alpha > 0, np.float32(2.0), np.float32(np.inf)))
    depth_m = np.full((HEIGHT, WIDTH), 3.0, np.float32)
    depth_m[100:120, 100:120] = 1.0
    plate = replace(plate_of(photograph().rgb, LENS, depth_m), depth_confidence=np.zeros((HEIGHT, WIDTH), np.float32))
    assert "25% of it is hidden by depth that is a guess" in str(hidden_warning([card], plate, "between", 0.4))
    assert hidden_warning([card], replace(plate, depth_confidence=np.full_like(alpha, 0.5)), "between", 0.4) is None
    assert hidden_warning([card], plate, "front", 0.4) is None
    assert hidden_warning([card], replace(plate, near_alpha=np.zeros_like(alpha)), "between", 0.4) is None, "a matte tells"


PLACES = {"object_": [CAKE, ALIEN], "at_pixel": ["1,2", "3,4"]}


@pytest.mark.parametrize(("given", "told"), [
    ({"at_pixel": ["1,2"]}, "--at-pixel: expected 2, one for each --object, got 1"),
    ({"at_pixel": None, "at": ["0,0,1", "0,0,2", "0,0,3"]}, "--at: expected 2, one for each --object, got 3"),
    ({"height": ["0.1", "0.2", "0.3"]}, "--height: expected 2, one for each --object, or one for all, got 3"),
    ({"object_": [CAKE], "at_pixel": ["1,2"], "turn": [1.0, 2.0]}, "--turn: expected one, got 2"),
    ({"object_": None}, "--at-pixel: expected one, got 2"),
    ({"at_pixel": ["1,2", "3"]}, "--at-pixel expects 2 numbers"),
    ({"height": ["0.1", "high"]}, "--height: expected metres above 0"),
])  # fmt: skip
def test_other_counts_are_refused(given: dict[str, Sequence[object]], told: str) -> None:
    with pytest.raises(InputError, match=told):
        replace(ObjectOptions(**PLACES), **given).require_meant(Path("photo.jpg"), None, None)  # type: ignore[arg-type]


def test_the_command_takes_all_and_tells_of_each(tmp_path: Path) -> None:
    write_image(tmp_path / "photo.exr", photograph().rgb)
    words = ("composite", tmp_path / "photo.exr", "--object", ALIEN, "--at-pixel", "80,200", "--object", CAKE, "--at-pixel", "280,180")
    lens = ("--focal-length", 36, "--sensor-width", 36, "--pitch", 0, "--camera-height", 1, "--height", 0.4)
    done = mrbokeh(*words, *lens, "--height", 0.8, "--preview", "--out", tmp_path / "out.png")
    assert done.returncode == 0, done.stderr
    assert re.search(r"4\.\d+ to 4\.\d+ m away, .*cells of 0\.5 m; 5\.\d+ to 6\.\d+ m away", done.stdout)
    done = mrbokeh(*words, *lens, "--height", 0.8, "--height", 0.9, "--out", tmp_path / "bad.png")
    assert done.returncode == 2 and "--height: expected 2, one for each --object, or one for all, got 3" in done.stderr
    assert not (tmp_path / "bad.png").exists()
