"""The shadow layer: black, as dark as asked, at the depth of the ground; and of what a scene's renderer is."""

import numpy as np
import pytest

from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera, level_plane_dioptres
from mrbokeh.scene import Mesh, Scene, SceneRenderer, shadow_catcher
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.virtual_scene import shadow_layer

GROUND_Y_M = 0.4


def camera() -> Camera:
    """1 m above the ground, level."""
    pose = np.eye(4)
    pose[1, 3] = 1.0 - GROUND_Y_M
    return Camera(40, 30, (50.0, 50.0), (20.0, 15.0), pose)


class HalfShade:
    """Lets a quarter of the light through in the left half of the picture, all of it in the right."""

    def render(self, _scene: Scene, _camera: Camera) -> Layer:
        raise AssertionError("a shadow needs no picture")

    def render_shadow_mask(self, _scene: Scene, camera: Camera, _catcher: Mesh) -> np.ndarray:
        mask = np.ones((camera.height_px, camera.width_px), np.float32)
        mask[:, :20] = 0.25
        return mask


def test_the_shadow_is_black_at_the_depth_of_the_ground() -> None:
    """0.8 of the light that is missing: 0.8 * 0.75 = 0.6. Row i sees the ground at 1 m * 50 px / (i + 0.5 - 15 px)."""
    layer = shadow_layer(HalfShade(), Scene(()), camera(), shadow_catcher(GROUND_Y_M, (0.0, 2.0), 3.0), 0.8)
    assert not layer.rgb.any()
    np.testing.assert_allclose(layer.alpha[:, :20], 0.6, rtol=1e-6)
    assert not layer.alpha[:, 20:].any() and np.isinf(layer.depth_m[:, 20:]).all()
    np.testing.assert_allclose(layer.depth_m[15:, 0], 50.0 / (np.arange(15, 30) + 0.5 - 15.0), rtol=1e-5)
    assert np.isinf(layer.depth_m[:15]).all(), "above the horizon there is no ground"


def test_its_depth_is_that_of_the_plane_in_any_pose() -> None:
    turn = np.deg2rad(35.0)
    pose = camera().camera_from_world.copy()
    tilt = np.eye(4)
    tilt[1:3, 1:3] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    tilted = Camera(40, 30, (50.0, 50.0), (20.0, 15.0), tilt @ pose)
    layer = shadow_layer(HalfShade(), Scene(()), tilted, shadow_catcher(GROUND_Y_M, (0.0, 2.0), 3.0), 1.0)
    np.testing.assert_allclose(1.0 / layer.depth_m[:, :20], level_plane_dioptres(tilted, GROUND_Y_M)[:, :20], rtol=1e-6)


@pytest.mark.parametrize(("candidate", "is_one"), [(HalfShade(), True), (EmbreeRaycaster(), True), (Scene(()), False)])
def test_renderers_of_scenes_are_told_apart_while_the_program_runs(candidate: object, is_one: bool) -> None:
    assert isinstance(candidate, SceneRenderer) == is_one
