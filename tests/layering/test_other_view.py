"""A second view of the scene as the source of what the first one hides."""

from dataclasses import replace

import numpy as np

from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import opaque
from mrbokeh.layering.hidden_background import layer_from_view
from mrbokeh.layering.layering import Layering, render_layers
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.scatter_reference import ScatterReference
from tests.support.refusals import refused

WIDTH, HEIGHT = 96, 64
CAMERA = Camera(WIDTH, HEIGHT, (96.0, 96.0), (WIDTH / 2, HEIGHT / 2))
WALL_M, POST_M = 4.0, 1.0


def moved(right_m: float) -> Camera:
    camera_from_world = np.eye(4)
    camera_from_world[0, 3] = -right_m
    return replace(CAMERA, camera_from_world=camera_from_world)


def wall_colour(x_m: np.ndarray, y_m: np.ndarray) -> np.ndarray:
    """A pattern that no interpolation guesses: tiles of random colour, 0.17 m wide (4 px)."""
    tiles = np.random.default_rng(0).uniform(0.0, 1.0, (64, 64, 3))
    return tiles[np.floor(y_m / 0.17).astype(int) % 64, np.floor(x_m / 0.17).astype(int) % 64]


def seen_by(camera: Camera, with_post: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """Colour and depth of a wall at 4 m and a black post at 1 m, 0.12 m wide, as a pinhole camera sees them."""
    plane = (camera.pixel_centres_px() - np.asarray(camera.principal_px)) / np.asarray(camera.focal_px)
    eye_x = -camera.camera_from_world[0, 3]
    rgb = wall_colour(plane[..., 0] * WALL_M + eye_x, plane[..., 1] * WALL_M)
    depth_m = np.full((HEIGHT, WIDTH), WALL_M)
    post = np.abs(plane[..., 0] * POST_M + eye_x) < 0.06
    if with_post:
        rgb, depth_m = np.where(post[..., None], 0.0, rgb), np.where(post, POST_M, depth_m)
    return rgb.astype(np.float32), depth_m.astype(np.float32)


def test_points_land_where_their_parallax_puts_them() -> None:
    rgb, depth_m = seen_by(CAMERA)
    layer = layer_from_view(rgb, depth_m, CAMERA, CAMERA)
    np.testing.assert_array_equal(layer.rgb, rgb)
    np.testing.assert_allclose(layer.depth_m, depth_m, rtol=1e-6)
    # 0.25 m aside the wall moves by 96 * 0.25 / 4 = 6 px and the post by 24: both whole pixels, so colours are kept exactly.
    rgb, depth_m = seen_by(moved(0.25))
    layer = layer_from_view(rgb, depth_m, moved(0.25), CAMERA)
    expected, _ = seen_by(CAMERA, with_post=False)
    wall = (layer.alpha > 0) & (layer.depth_m > 2.0)
    assert wall.mean() > 0.65
    np.testing.assert_array_equal(layer.rgb[wall], expected[wall])
    assert (layer.depth_m[:, WIDTH // 2] == np.float32(POST_M)).all(), "the post is where it is"
    rgb, depth_m = seen_by(CAMERA)
    refused("resize", layer_from_view, rgb[:-2].copy(), depth_m[:-2].copy(), CAMERA, CAMERA)


def test_what_another_view_saw_is_nearer_to_the_truth_than_what_was_guessed() -> None:
    """Focus on the wall: behind the blurred post the lens sees the wall, which two views from beside saw, too."""
    lens = Lens(50.0, 0.3, WALL_M, 50.0)  # the post blurs over 12 px, its own width
    rgb, depth_m = seen_by(CAMERA)
    clean, _ = seen_by(CAMERA, with_post=False)
    others = [layer_from_view(*seen_by(moved(x_m)), moved(x_m), CAMERA, depth_m) for x_m in (0.25, -0.25)]
    spread, layering = ScatterReference().sum_kernels, Layering()
    picture = opaque(rgb, depth_m)
    truth = render_layers([picture, opaque(clean, np.full_like(depth_m, WALL_M))], lens, spread, layering).rgb
    guessed = render_layers([picture], lens, spread, layering).rgb
    informed = render_layers([picture, *others], lens, spread, layering).rgb
    around = np.s_[:, WIDTH // 2 - 8 : WIDTH // 2 + 8]
    assert psnr(informed[around], truth[around]) > psnr(guessed[around], truth[around]) + 6.0
