import numpy as np
import pytest

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError


def turned_camera() -> Camera:
    angle_rad = 0.3
    pose = np.eye(4)
    pose[:3, :3] = [[np.cos(angle_rad), 0, np.sin(angle_rad)], [0, 1, 0], [-np.sin(angle_rad), 0, np.cos(angle_rad)]]
    pose[:3, 3] = [0.1, -0.2, 0.5]
    return Camera(640, 360, (520.0, 515.0), (300.3, 190.7), pose)


def test_points_land_where_a_pinhole_sees_them_and_come_back() -> None:
    camera = Camera(640, 480, (500.0, 500.0), (320.0, 240.0))
    xy_px, depth_m = camera.project(np.array([[0.0, 0.0, 2.0], [0.4, -0.2, 2.0]]))
    np.testing.assert_allclose(xy_px, [[320, 240], [320 + 0.2 * 500, 240 - 0.1 * 500]])
    np.testing.assert_allclose(depth_m, 2.0)
    camera = turned_camera()
    points_m = np.random.default_rng(0).uniform((-0.5, -0.5, 2.5), (0.5, 0.5, 3.5), (50, 3))
    np.testing.assert_allclose(camera.unproject(*camera.project(points_m)), points_m, atol=1e-12)
    half = camera.resized(320, 180)
    points_m = np.array([[0.1, 0.2, 3.0]])
    np.testing.assert_allclose(half.project(points_m)[0], camera.project(points_m)[0] / 2)


def test_pixels_have_their_centres_at_one_half_and_a_camera_has_a_size() -> None:
    centres = Camera(4, 3, (1.0, 1.0), (2.0, 1.5)).pixel_centres_px()
    assert centres.shape == (3, 4, 2)
    np.testing.assert_array_equal(centres[0, 0], [0.5, 0.5])
    np.testing.assert_array_equal(centres[2, 3], [3.5, 2.5])
    with pytest.raises(InputError, match="intrinsics"):
        Camera(0, 10, (1.0, 1.0), (0.0, 0.0))
