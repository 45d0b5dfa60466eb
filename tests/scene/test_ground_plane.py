"""The homography that the page drags objects with, against projecting points of the table."""

import numpy as np
import pytest

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.world_axes import turned
from viewfinder.stage.shown_scene import ground_from_picture


def looking_down(tilt_rad: float) -> Camera:
    """Half a metre above a board (x right, y down along it, z into it), looking away from us and down."""
    cosine, sine = np.cos(tilt_rad), np.sin(tilt_rad)
    camera_from_world = np.eye(4)
    # The picture's right is the board's; its forward is up the board (-y) and into it (+z).
    camera_from_world[:3, :3] = [[1, 0, 0], [0, sine, cosine], [0, -cosine, sine]]
    camera_from_world[:3, 3] = -camera_from_world[:3, :3] @ np.array([0.1, 0.5, -0.5])
    return Camera(640, 360, (520.0, 515.0), (300.3, 190.7), camera_from_world)


@pytest.mark.parametrize("tilt_rad", [0.6, 0.9, 1.2])
def test_a_place_on_the_table_is_found_from_where_it_is_seen(tilt_rad: float) -> None:
    camera = looking_down(tilt_rad)
    homography = ground_from_picture(camera, "-z")
    assert homography is not None
    for point_m in ([0.1, 0.0, 0.0], [0.2, 0.1, 0.0], [-0.05, -0.2, 0.0]):
        (x_px, y_px), depth_m = camera.project(np.array(point_m))
        assert depth_m > 0
        x, z, w = homography @ [x_px / 640, y_px / 360, 1.0]
        upright_x, _, upright_z = turned((point_m[0], point_m[1], point_m[2]), "-z")
        assert (x / w, z / w) == pytest.approx((upright_x, upright_z), abs=1e-9)


def test_an_eye_in_the_table_sees_no_place_on_it() -> None:
    camera_from_world = np.eye(4)
    assert ground_from_picture(Camera(64, 48, (50.0, 50.0), (32.0, 24.0), camera_from_world), "-y") is None
