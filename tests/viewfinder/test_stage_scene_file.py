"""The scene file of the viewfinder: what it says, and the sentence for every mistake; what is loaded from it."""

import math
import os
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.scene.staging.scene_file import read_scene_file
from mrbokeh.scene.staging.staged_scene import Assets, StagedScene
from mrbokeh.system.errors import InputError
from tests.support.refusals import refused
from tests.support.stage_scenes import ONE_CARD, card, described, scene_file, staged
from viewfinder.stage.stage_setup import SceneWatch

ROOT = Path(__file__).resolve().parents[2]


def test_everything_that_a_file_may_say(tmp_path: Path) -> None:
    for name in ("sky.exr", "depth.exr", "camera.json", "lens.json"):
        (tmp_path / name).touch()
    scene = described(
        tmp_path,
        """
        up = "+z"
        [[object]]
        name = "a"
        glb = "card.glb"
        position_m = [0.1, 0.2, 0]
        yaw_deg = 90
        scale = 0.5
        animation = "Walk"
        loop = false
        visible = false
        [[object]]
        name = "b"
        glb = "card.glb"
        height_m = 0.3
        [light]
        environment = "sky.exr"
        rotation_deg = -180
        exposure = 2
        [[sun]]
        direction = [0, 0, -1]
        irradiance = [3, 2, 1]
        [shadow]
        size_m = 2
        strength = 0.5
        centre_m = [1, 1, 0]
        [occlusion]
        depth = "depth.exr"
        camera = "camera.json"
        [lens]
        file = "lens.json"
        [renderer]
        name = "low-rank"
        """,
    )
    first, second = scene.objects
    assert (first.position_m, first.yaw_rad, first.height_m, first.scale) == ((0.1, 0.2, 0.0), math.pi / 2, None, 0.5)
    assert (first.animation, first.loop, first.visible, second.height_m, second.visible) == ("Walk", False, False, 0.3, True)
    assert scene.light.environment == tmp_path / "sky.exr" and scene.light.rotation_rad == -math.pi and scene.light.exposure == 2.0
    assert scene.light.suns[0].irradiance == (3.0, 2.0, 1.0)
    assert scene.shadow is not None and scene.shadow.centre_m == (1.0, 1.0, 0.0)
    assert (scene.up, scene.lens, scene.renderer) == ("+z", tmp_path / "lens.json", "low-rank")
    names = ("scene.toml", "card.glb", "card.glb", "sky.exr", "depth.exr", "camera.json", "lens.json")
    assert scene.files == tuple(tmp_path / name for name in names)


def test_a_mistake_is_one_sentence_that_names_it(tmp_path: Path) -> None:
    for text, told in (
        ("[[object]\n", "cannot be read as such"), ("[object]\nname = 'a'", "written as [[object]]"),
        ("colour = 3", "nothing knows the key 'colour'"), ("[[object]]\nname = 'a'", "glb missing"),
        ("[[object]]\nname = 'a'\nglb = 'no.glb'", "expected glb to be a file"),
        ("[[object]]\nname = ''\nglb = 'card.glb'", "expected name to be a text"), (ONE_CARD + "scale = 2", "height_m or scale"),
        (ONE_CARD + ONE_CARD, "'card' comes twice"),
        (ONE_CARD + "position_m = [1, 2]", "[[object]] 'card': expected position_m to be a list of 3 numbers"),
        (ONE_CARD + "yaw_deg = 'left'", "expected yaw_deg to be a number, got 'left'"),
        (ONE_CARD + "visible = 1", "expected visible to be true or false"), (ONE_CARD + "size = 1", "nothing knows the key 'size'"),
        ("[[object]]\nname = 'a'\nglb = 'card.glb'\nheight_m = 0", "expected height_m to be a number above 0, got '0'"),
        ("up = 'z'", "expected up to be one of +y, +z, -y, -z"),
        ("[light]\nexposure = -1", "[light]: expected exposure to be a number above 0"),
        ("[[sun]]\nirradiance = 3", "expected direction"),
        ("[[sun]]\ndirection = [0, 0, 1]\nirradiance = -1", "expected irradiance to be a number of 0 or more"),
        ("[shadow]\nstrength = 1.5", "expected strength to be a number from 0 to 1"),
        ("[occlusion]\ndepth = 'card.glb'", "expected depth and camera, or mask alone, got depth"),
        ("[lens]\nfile = 'no.json'", "expected file to be a file"), ("[renderer]\nname = 5", "expected name to be a text"),
    ):  # fmt: skip
        with pytest.raises(InputError) as caught:
            described(tmp_path, text)
        assert told in str(caught.value) and "scene.toml" in str(caught.value)
    refused("expected animation to be one of", staged, tmp_path, ONE_CARD + "animation = 'Fly'\n")


def test_the_example_in_the_documentation_reads_with_all_that_it_comments_out(tmp_path: Path) -> None:
    text = (ROOT / "docs" / "viewfinder_scene.toml").read_text(encoding="utf-8")
    for name in ("studio.hdr", "lens.json", "in_front.png"):
        (tmp_path / name).touch()
    assert read_scene_file(ROOT / "docs" / "viewfinder_scene.toml").objects[0].glb.is_file()
    text = text.replace("../mrbokeh", str(ROOT / "mrbokeh"))
    assert described(tmp_path, text).objects[0].name == "alien"
    # Optional lines begin with "# " and hold a table or a key; depth and mask exclude one another.
    names = ("[", "up", "animation", "loop", "vis", "dir", "irr", "cent", "mask", "env", "rot", "exp", "file")
    optional = tuple(f"# {name}" for name in names)
    lines = [line[2:] if line.startswith(optional) else line for line in text.splitlines()]
    scene = described(tmp_path, "\n".join(lines))
    assert scene.objects[0].animation == "Walk" and scene.light.suns and scene.shadow and scene.occlusion


def test_an_object_stands_on_the_board(tmp_path: Path) -> None:
    # A board has z into the table: upright y. Its y comes towards the viewer: upright -z. The card is as wide as high.
    scene = staged(tmp_path, ONE_CARD + "position_m = [0.3, 0.5, -0.1]\n").scene_at(0.0)
    low, high = scene.bounds_m
    assert np.allclose(low, [0.2, -0.3, -0.5], atol=1e-6) and np.allclose(high, [0.4, -0.1, -0.5], atol=1e-6)


def test_light_comes_from_where_the_file_says(tmp_path: Path) -> None:
    # On a board light that falls straight onto the table travels along +z: upright +y.
    lights, environment = staged(tmp_path, ONE_CARD + "[[sun]]\ndirection = [0, 0, 2]\nirradiance = 3\n").scene_at(0.0).lighting
    assert [light.direction for light in lights] == [(0.0, 1.0, 0.0)] and lights[0].rgb == (3.0, 3.0, 3.0)
    assert environment is not None


def test_the_sun_of_a_panorama_becomes_a_light_unless_the_file_has_one(tmp_path: Path) -> None:
    sky = np.full((64, 128), 0.5, np.float32)
    sky[15:17, 63:65] = 100.0
    write_exr(tmp_path / "sky.exr", ExrPart(dict.fromkeys("RGB", sky)))
    text = ONE_CARD + "[light]\nenvironment = 'sky.exr'\n"
    lights, environment = staged(tmp_path, text).scene_at(0.0).lighting
    # Rows 15 and 16 of 64 lie 45 degrees high, the middle column straight ahead: its light falls down and towards the viewer.
    assert len(lights) == 1 and np.allclose(lights[0].direction, (0, 0.5**0.5, -(0.5**0.5)), atol=1e-3)
    assert environment is not None and environment.radiance.max() < 100.0
    lights, environment = staged(tmp_path, text + "[[sun]]\ndirection = [1, 0, 0]\n").scene_at(0.0).lighting
    assert [light.direction for light in lights] == [(1.0, 0.0, 0.0)]
    assert environment is not None and environment.radiance.max() == 100.0


def test_moving_and_hiding_make_new_versions(tmp_path: Path) -> None:
    before = staged(tmp_path)
    moved = before.with_object("card", position_m=(1.0, 0.0, 0.0))
    assert np.allclose(moved.scene_at(0.0).bounds_m[0] - before.scene_at(0.0).bounds_m[0], [1, 0, 0])
    assert before.with_object("card", visible=False).scene_at(0.0).meshes == ()
    assert before.scene_at(0.0) is before.scene_at(3.0), "a scene that does not move is one object"
    refused("card", before.with_object, "cart", visible=False)


def test_assets_are_kept_until_their_file_changes(tmp_path: Path) -> None:
    assets, path = Assets(), scene_file(tmp_path, ONE_CARD)
    first = StagedScene.load(read_scene_file(path), assets).objects[0].asset
    assert StagedScene.load(read_scene_file(path), assets).objects[0].asset is first
    os.utime(tmp_path / "card.glb", (1.0, 1.0))
    assert StagedScene.load(read_scene_file(path), assets).objects[0].asset is not first


def test_a_change_is_seen_once_the_file_keeps_still(tmp_path: Path) -> None:
    glb = card(tmp_path)
    watch = SceneWatch([glb, tmp_path / "gone.glb"])
    assert not watch.changed()
    os.utime(glb, (1.0, 1.0))
    assert not watch.changed() and watch.changed() and watch.changed()
    watch.follow([glb])
    assert not watch.changed() and not watch.changed()
