"""The level plane against similar triangles and against projecting its points."""

import numpy as np
import pytest

from mrbokeh.optics.camera import Camera, level_plane_dioptres


def tilted(tilt_rad: float, eye_m: tuple[float, float, float]) -> Camera:
    """Looks down by the tilt."""
    cosine, sine = np.cos(tilt_rad), np.sin(tilt_rad)
    camera_from_world = np.eye(4)
    camera_from_world[1:3, 1:3] = [[cosine, -sine], [sine, cosine]]
    camera_from_world[:3, 3] = -camera_from_world[:3, :3] @ eye_m
    return Camera(64, 48, (80.0, 75.0), (30.0, 20.0), camera_from_world)


def test_a_level_camera_sees_it_by_similar_triangles_from_above_and_below() -> None:
    """1.5 m below the eye, in row i: depth 1.5 m * 75 px / (i + 0.5 - 20 px); nothing above the horizon at 20 px."""
    dioptres = level_plane_dioptres(tilted(0.0, (0.3, -1.0, 2.0)), 0.5)
    rows = np.arange(48) + 0.5 - 20.0
    np.testing.assert_allclose(dioptres, np.tile(np.maximum(rows / (1.5 * 75.0), 0.0)[:, None], (1, 64)), rtol=1e-6)
    dioptres = level_plane_dioptres(tilted(0.0, (0.0, 1.0, 0.0)), 0.0)
    assert (dioptres[:20] > 0).all() and not dioptres[20:].any()
    assert not level_plane_dioptres(tilted(0.4, (0.0, 0.25, 0.0)), 0.25).any()


@pytest.mark.parametrize("y_m", [0.0, -0.2, 0.7])
def test_depths_are_those_of_its_points(y_m: float) -> None:
    """Pixels thrown onto the plane at the depth told come down on it."""
    camera = tilted(0.7, (0.1, -0.9, -0.4))
    dioptres = level_plane_dioptres(camera, y_m)
    assert (dioptres > 0).all()
    on_plane = camera.unproject(camera.pixel_centres_px(), 1.0 / dioptres)
    np.testing.assert_allclose(on_plane[..., 1], y_m, atol=1e-5)
