"""The shadow of an object is drawn only where it can fall: what comes out is that of the whole frame."""

from pathlib import Path

import numpy as np
import pytest

from mrbokeh.optics.camera import Camera
from mrbokeh.scene.staging.filming import FilmedLayers, Filming
from mrbokeh.scene.staging.picture_box import shadow_box
from mrbokeh.scene.staging.scene_description import OneObject
from mrbokeh.scene.virtual_scene import shadow_layer
from mrbokeh.tracking.world_axes import upright_camera

ALIEN = Path(__file__).resolve().parents[2] / "mrbokeh" / "demo_data" / "objects" / "alien.glb"
CAMERA = Camera(160, 112, (220.0, 220.0), (80.0, 56.0))


@pytest.mark.parametrize("stands_at_m", [(0.1, 0.3, 2.0), (-0.6, 0.4, 1.6), (0.0, 0.2, 0.6)])
def test_the_shadow_is_that_of_the_whole_frame(stands_at_m: tuple[float, float, float]) -> None:
    one = OneObject(ALIEN, stands_at_m, height_m=0.25, tilt_rad=0.2, shadow=0.7)
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
