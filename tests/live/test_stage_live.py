"""The live stage draws with cheaper settings than captures, keeps what it prepared while objects and light are moved, and says the same."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from mrbokeh.images.image_io import read_linear
from mrbokeh.scene import split_sun
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.light import Environment
from mrbokeh.scene.mesh import rigid_motion
from mrbokeh.scene.staging.picture_box import drawn_points_m
from mrbokeh.scene.staging.scene_description import Lighting, Sun
from mrbokeh.scene.staging.staged_scene import Assets
from mrbokeh.tracking.world_axes import upright_camera
from tests.scenes.stage_scenes import LENS, ONE_CARD, camera, render_setup, scene_file, staged
from viewfinder.stage.drawing import DrawRequest, draw, sharp_layers
from viewfinder.stage.stage_setup import SetupLoader, live_backend

SHADOW = ONE_CARD + "[[sun]]\ndirection = [0, -1, 1]\nirradiance = 3\n[shadow]\nstrength = 0.75\n"


def test_drawings_are_live_and_captures_are_not(tmp_path: Path) -> None:
    loader = SetupLoader(scene_file(tmp_path, SHADOW), EmbreeRaycaster(threads=1))
    setup, upright = loader.load(), upright_camera(camera((0.05, 0.3, -1.2), (0.0, -0.1, 0.0)), "-z")
    assert setup.render_setup.live is not None
    live = setup.render_setup.live.render(setup.staged.scene_at(0.0), upright)
    assert set(np.unique(live.alpha)) <= {0.0, 0.25, 0.5, 0.75, 1.0}
    card, shadow = sharp_layers(setup.staged, 0.0, upright, setup.render_setup)
    expected = EmbreeRaycaster().render(setup.staged.scene_at(0.0), upright)
    assert np.array_equal(card.alpha, expected.alpha)
    assert (
        len(np.unique(card.alpha)) > 5 >= len(np.unique(live_backend(EmbreeRaycaster()).render(setup.staged.scene_at(0.0), upright).alpha))
    )
    assert setup.staged.catcher is not None
    mask = EmbreeRaycaster().render_shadow_mask(setup.staged.scene_at(0.0), upright, setup.staged.catcher)
    assert np.allclose(shadow.alpha, 0.75 * (1 - mask))


def test_any_other_backend_draws_live_pictures_too() -> None:
    class Other:
        render = EmbreeRaycaster.render
        render_shadow_mask = EmbreeRaycaster.render_shadow_mask

    other = Other()
    assert live_backend(other) is other  # type: ignore[arg-type]


def test_a_live_drawing_is_near_the_best(tmp_path: Path) -> None:
    tools, scene = render_setup(), staged(tmp_path, SHADOW)
    live = replace(tools, live=live_backend(tools.backend))
    request = DrawRequest(camera((0.05, 0.3, -1.2), (0.0, -0.1, 0.0)), LENS)
    best, fast = draw(scene, request, tools).sharp, draw(scene, request, live).sharp
    assert best is not None and fast is not None
    # Only edges differ: of the card by a quarter at most; of the shadow (0.75 dark) by half of it, where two pixels are interpolated.
    assert 0 < np.abs(best.rgba - fast.rgba).max() < 0.75 / 2 + 0.05
    assert fast.rgba.sum((0, 1)) == pytest.approx(best.rgba.sum((0, 1)), rel=0.02)


def test_a_moved_object_shares_what_was_loaded(tmp_path: Path) -> None:
    before = staged(tmp_path)
    after = before.with_object("card", position_m=(0.1, 0.2, 0.0), yaw_rad=0.5)
    motion = rigid_motion(before.scene_at(0.0).meshes, after.scene_at(0.0).meshes)
    assert motion is not None
    # Upright axes: x as the table's, y down, z away: (0.1, 0.2, 0) of a board whose y comes towards the viewer.
    foot_m = np.array([0.0, 0.0, 0.0, 1.0])
    assert (motion @ foot_m)[:3] == pytest.approx(upright_point(0.1, 0.2, 0.0), abs=1e-9)
    bigger = before.with_object("card", height_m=0.3)
    assert rigid_motion(before.scene_at(0.0).meshes, bigger.scene_at(0.0).meshes) is None


def upright_point(x: float, y: float, z: float) -> tuple[float, float, float]:
    """ "-z" is up: x stays, what goes into the table goes down, and the board's y points towards the viewer."""
    return x, z, -y


def test_points_are_those_of_the_scene(tmp_path: Path) -> None:
    scene = staged(tmp_path, SHADOW)
    first = scene.drawn_points_m(0.0)
    assert np.array_equal(first, drawn_points_m(scene.scene_at(0.0), scene.catcher))
    assert scene.drawn_points_m(0.0) is first
    moved = scene.with_object("card", position_m=(0.5, 0.0, 0.0))
    assert np.array_equal(moved.drawn_points_m(0.0), drawn_points_m(moved.scene_at(0.0), moved.catcher))


@pytest.mark.parametrize("exposure", [1.0, 1.7])
def test_a_panorama_is_turned_and_exposed_after_its_sun_was_split_off(tmp_path: Path, exposure: float) -> None:
    rng = np.random.default_rng(0)
    radiance = rng.uniform(0.2, 0.4, (32, 64, 3)).astype(np.float32)
    radiance[8, 40] = 900.0
    path = tmp_path / "sky.hdr"
    assert cv2.imwrite(str(path), radiance[..., ::-1])
    stored = read_linear(path)
    assets = Assets()
    assets.light(Lighting(path), "-z")
    sky, lights = assets.light(Lighting(path, 0.6, exposure), "-z")
    expected_sky, expected_sun = split_sun(Environment(stored).turned(0.6).brighter(exposure))
    assert sky is not None and len(lights) == 1
    assert np.allclose(sky.radiance, expected_sky.radiance, rtol=1e-5)
    assert np.allclose(sky.world_from_environment, expected_sky.world_from_environment)
    assert np.allclose(lights[0].rgb, expected_sun.rgb, rtol=1e-5)
    assert np.allclose(lights[0].direction, expected_sun.direction, atol=1e-6)
    whole, suns = assets.light(Lighting(path, 0.6, exposure, (Sun((0.0, 0.0, 1.0), (1.0, 1.0, 1.0)),)), "-z")
    assert whole is not None and len(suns) == 1
    assert np.allclose(whole.radiance, stored * np.float32(exposure), rtol=1e-5)
