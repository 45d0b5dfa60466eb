"""The shadow of an object is drawn only where it can fall: what comes out is that of the whole frame."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.optics.camera import Camera
from mrbokeh.scene.moving_layers import ShutterTiming
from mrbokeh.scene.staging.filming import FilmedLayers, Filming
from mrbokeh.scene.staging.picture_box import shadow_box
from mrbokeh.scene.staging.scene_description import OneObject, looking_down
from mrbokeh.scene.virtual_scene import shadow_layer
from mrbokeh.tracking.world_axes import upright_camera

ALIEN = Path(__file__).resolve().parents[2] / "mrbokeh" / "demo_data" / "objects" / "alien.glb"
CAMERA = Camera(160, 112, (220.0, 220.0), (80.0, 56.0))


@pytest.mark.parametrize("stands_at_m", [(0.1, 0.3, 2.0), (-0.6, 0.4, 1.6), (0.0, 0.2, 0.6)])
def test_the_shadow_is_that_of_the_whole_frame(stands_at_m: tuple[float, float, float]) -> None:
    one = OneObject(ALIEN, stands_at_m, height_m=0.25, world_from_camera=looking_down(0.2), shadow=0.7)
    filmed = FilmedLayers(Filming("embree"), one.described(), threads=1)
    camera = upright_camera(one.seen_by(CAMERA), filmed._staged.description.up)
    scene, catcher = filmed._staged.scene_at(0.0), filmed._staged.catcher
    assert catcher is not None
    found, whole = filmed.at(lambda _: one.seen_by(CAMERA))[-1], shadow_layer(filmed._renderer, scene, camera, catcher, 0.7)
    assert (whole.alpha > 0.3).sum() > 50 and (whole.rgb == 0.0).all()
    rows, columns = shadow_box(scene, camera, catcher).size_px
    assert rows * columns < 0.8 * 160 * 112
    np.testing.assert_allclose(found.alpha, whole.alpha, atol=1e-6)
    np.testing.assert_allclose(found.depth_m, whole.depth_m, rtol=1e-5)


def test_the_front_of_an_object_looks_at_the_camera_until_it_is_turned() -> None:
    """The alien's eyes, the only grey of its head, lie at +z of its file (glTF 2.0: the front of an asset faces +Z)."""

    def eyes(turn_rad: float) -> int:
        one = OneObject(ALIEN, (0.0, 0.4, 2.0), height_m=0.8, turn_rad=turn_rad)
        alien = FilmedLayers(Filming("embree"), one.described(), threads=1).at(lambda _: one.seen_by(CAMERA))[0]
        head = np.nonzero((alien.alpha == 1.0).any(axis=1))[0][:40]
        rgb = alien.rgb[head][alien.alpha[head] == 1.0]
        return int((np.ptp(rgb, axis=1) < 0.2 * rgb.max(axis=1)).sum())

    assert eyes(0.0) > 20 and eyes(np.pi) == 0


def test_layers_agree_on_motion_where_only_one_of_them_moves() -> None:
    """The head of the alien is in the picture, its foot and the shadow are not, and the camera goes to the right."""
    one = OneObject(ALIEN, (0.0, 0.7, 2.0), height_m=0.3, shadow=0.7)
    filmed = FilmedLayers(Filming("embree", shutter=ShutterTiming(frame_rate=25.0)), one.described(), threads=1)

    def camera_at(time_s: float) -> Camera:
        seen, shift = one.seen_by(CAMERA), np.eye(4)
        shift[0, 3] = -time_s
        return replace(seen, camera_from_world=shift @ seen.camera_from_world)

    alien, shadow = filmed.at(camera_at)
    assert (alien.alpha > 0).any() and not (shadow.alpha > 0).any()
    moved_px = alien.extra["motion_px"][alien.alpha == 1.0]
    np.testing.assert_allclose(moved_px.mean(0), (-220.0 / 2.0 / 50.0, 0.0), atol=0.2)  # focal length, distance, 1/50 s open
    assert shadow.extra["motion_px"].shape == alien.extra["motion_px"].shape and not shadow.extra["motion_px"].any()
