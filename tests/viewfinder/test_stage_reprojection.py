"""Late reprojection: where moved pixels land, by the pinhole's own equations, and what becomes of their light."""

from dataclasses import replace

import numpy as np
import pytest

from mrbokeh.compositing.overlay import Overlay
from mrbokeh.optics.camera import Camera
from tests.support.stage_scenes import centroid, looking
from viewfinder.stage.reprojection import GRID_PX, NODE_PX, MovableLayer, filled_outwards

FRAME = Camera(160, 112, (150.0, 150.0), (80.0, 56.0))
LEFT, TOP, WIDTH, HEIGHT = 48, 32, 64, 48
DEPTH_M = 2.0


def cut(camera: Camera) -> Camera:
    principal = camera.principal_px[0] - LEFT, camera.principal_px[1] - TOP
    return Camera(WIDTH, HEIGHT, camera.focal_px, principal, camera.camera_from_world)


def layer(rgba: np.ndarray, depth_m: float | np.ndarray = DEPTH_M) -> MovableLayer:
    """Premultiplied pixels in the box, all at one depth, or at those of the grid."""
    dioptres = np.full((HEIGHT // GRID_PX, WIDTH // GRID_PX), 1.0 / np.asarray(depth_m), np.float32)
    return MovableLayer(rgba.astype(np.float32), dioptres, cut(FRAME), LEFT, TOP)


def noise() -> np.ndarray:
    """Smooth enough to be resampled, dark at its border."""
    rng, rgba = np.random.default_rng(3), np.zeros((HEIGHT, WIDTH, 4), np.float32)
    rgba[8:-8, 8:-8] = rng.uniform(0.2, 1.0, (HEIGHT - 16, WIDTH - 16, 4))
    return rgba


def blob(x: float, y: float, sigma: float = 3.0) -> np.ndarray:
    """A Gaussian of light at a place of the box."""
    columns, rows = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    return np.repeat(np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))[..., None], 4, axis=2).astype(np.float32)


def shifted(right_m: float = 0.0, down_m: float = 0.0, forward_m: float = 0.0) -> Camera:
    pose = np.eye(4)
    pose[:3, 3] = -right_m, -down_m, -forward_m
    return replace(FRAME, camera_from_world=pose)


def whole(overlay: Overlay, camera: Camera = FRAME) -> np.ndarray:
    """(H, W, 4) of the frame."""
    rgba = np.zeros((camera.height_px, camera.width_px, 4), np.float32)
    height, width = overlay.shines_through.shape
    box = rgba[overlay.top_px : overlay.top_px + height, overlay.left_px : overlay.left_px + width]
    box[..., :3], box[..., 3] = overlay.rgb, 1.0 - overlay.shines_through
    return rgba


def placed(rgba: np.ndarray, right_px: int = 0, down_px: int = 0) -> np.ndarray:
    result = np.zeros((FRAME.height_px, FRAME.width_px, 4), np.float32)
    result[TOP + down_px : TOP + down_px + HEIGHT, LEFT + right_px : LEFT + right_px + WIDTH] = rgba
    return result


def test_the_pose_of_the_drawing_gives_the_drawing_bit_for_bit_and_one_that_hardly_differs_nearly() -> None:
    overlay = layer(noise()).moved_to(FRAME)
    assert (overlay.left_px, overlay.top_px) == (LEFT, TOP)
    assert np.array_equal(overlay.rgb, noise()[..., :3]) and np.array_equal(overlay.shines_through, 1 - noise()[..., 3])
    # 1 nm to the side at 2 m is 7.5e-8 px; noise of 1 px then differs by as much.
    assert np.abs(whole(layer(noise()).moved_to(shifted(1e-9))) - placed(noise())).max() < 1e-6


@pytest.mark.parametrize(("right_px", "down_px"), [(3, 0), (-5, 0), (2.25, 0), (4, -6)])
def test_movement_of_a_flat_layer_is_its_analytic_shift(right_px: float, down_px: int) -> None:
    # A camera that moves by t to the right sees a plane at z move by f t / z to the left; between pixels bilinearly.
    moved = whole(layer(noise()).moved_to(shifted(-right_px * DEPTH_M / 150.0, -down_px * DEPTH_M / 150.0)))
    less, share = int(np.floor(right_px)), right_px - np.floor(right_px)
    expected = (1 - share) * placed(noise(), less, down_px) + share * placed(noise(), less + 1, down_px)
    assert np.abs(moved - expected).max() < 1e-5


def test_each_blurred_point_moves_by_its_own_depth() -> None:
    # Two discs 32 px apart, from points at 1 m and at 4 m; the camera moves by 2 cm: they move by f t / z = 3 and 0.75 px.
    depth_m = np.where(np.arange(WIDTH // GRID_PX) < WIDTH // GRID_PX // 2, 1.0, 4.0)
    near, far = layer(blob(16, 24), depth_m), layer(blob(48, 24), depth_m)
    for each, x, z in ((near, 16, 1.0), (far, 48, 4.0)):
        found = centroid(whole(each.moved_to(shifted(right_m=0.02)))[..., 0])
        # At the border between the depths, 4 sigma away, 1 / depth is interpolated.
        assert found == pytest.approx((LEFT + x - 150.0 * 0.02 / z, TOP + 24), abs=0.02)


def test_a_slanted_plane_lands_where_the_camera_projects_it() -> None:
    # The plane 1 / z = 0.5 + 0.01 (x - 80) per metre; the new pose turns and moves in all ways a hand does within 0.1 s.
    x_px = LEFT + (np.arange(WIDTH // GRID_PX) + 0.5) * GRID_PX
    new = replace(
        FRAME, camera_from_world=np.linalg.inv(looking((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))) @ looking((0.02, 0.01, -0.03), (0.05, 1, 0))
    )
    for x, y in ((20.0, 14.0), (40.0, 30.0)):
        slanted = layer(blob(x, y), 1.0 / (0.5 + 0.01 * (x_px - 80.0)))
        point_m = FRAME.unproject(np.array([LEFT + x, TOP + y]), np.array(1.0 / (0.5 + 0.01 * (LEFT + x - 80.0))))
        assert centroid(whole(slanted.moved_to(new))[..., 0]) == pytest.approx(new.project(point_m)[0], abs=0.06)


def test_light_is_conserved_by_sideways_movement_and_grows_with_the_square_of_nearness() -> None:
    light = noise().sum()
    assert whole(layer(noise()).moved_to(shifted(0.0123, -0.0071))).sum() == pytest.approx(light, rel=1e-5)
    # From 2 m to 1.9 m everything is larger by 2 / 1.9, and equally bright: the stated bound is 1 %.
    nearer = whole(layer(blob(32, 24)).moved_to(shifted(forward_m=0.1))).sum()
    assert nearer == pytest.approx(blob(32, 24).sum() * (2 / 1.9) ** 2, rel=0.01)


def test_what_moves_out_of_the_frame_is_cut_and_what_comes_to_lie_behind_the_camera_is_gone() -> None:
    moved = whole(layer(noise()).moved_to(shifted(right_m=80 * DEPTH_M / 150.0)))
    assert np.abs(moved[:, : LEFT + WIDTH - 80] - placed(noise())[:, 80 : LEFT + WIDTH]).max() < 1e-5
    assert not layer(noise()).moved_to(shifted(right_m=3.0)).shines_through.size
    behind = replace(FRAME, camera_from_world=np.diag([-1.0, 1.0, -1.0, 1.0]))
    assert not whole(layer(noise()).moved_to(behind)).any()


def test_half_the_resolution_is_enlarged_in_place() -> None:
    # A disc of sigma 3 px drawn on half as many pixels is one of 1.5 px there; its light counts fourfold.
    small = Camera(WIDTH // 2, HEIGHT // 2, (75.0, 75.0), ((80.0 - LEFT) / 2, (56.0 - TOP) / 2))
    columns, rows = np.meshgrid(2 * np.arange(WIDTH // 2) + 1.0, 2 * np.arange(HEIGHT // 2) + 1.0)
    rgba = np.repeat(np.exp(-((columns - 30) ** 2 + (rows - 25) ** 2) / 18.0)[..., None], 4, axis=2).astype(np.float32)
    dioptres = np.full((HEIGHT // 8, WIDTH // 8), 1.0 / DEPTH_M, np.float32)
    moved = whole(MovableLayer(rgba, dioptres, small, LEFT, TOP, 0.5).moved_to(FRAME))[..., 1]
    assert centroid(moved) == pytest.approx((LEFT + 30, TOP + 25), abs=1e-3)
    assert moved.sum() == pytest.approx(blob(30, 25)[..., 0].sum(), rel=1e-3)


def test_another_size_of_the_frame_shows_the_same_view() -> None:
    large = whole(layer(blob(32, 24)).moved_to(FRAME.resized(320, 224)), FRAME.resized(320, 224))[..., 0]
    assert centroid(large) == pytest.approx((2 * (LEFT + 32), 2 * (TOP + 24)), abs=1e-2)
    assert large.sum() == pytest.approx(4 * blob(32, 24)[..., 0].sum(), rel=1e-3)


def test_opacity_fades_light_and_cover() -> None:
    for camera in (FRAME, shifted(0.01)):
        full, half = layer(noise()).moved_to(camera), layer(noise()).moved_to(camera, 0.5)
        assert np.allclose(half.rgb, 0.5 * full.rgb) and np.allclose(1 - half.shines_through, 0.5 * (1 - full.shines_through), atol=1e-6)


def plainly_moved(movable: MovableLayer, camera: Camera) -> np.ndarray:
    """The twin: every pixel by itself, in numpy, with the cameras' own project and unproject."""
    xy_px = camera.pixel_centres_px().reshape(-1, 2)
    drawn, eye_m = movable.camera, camera.world_from_camera[:3, 3]
    rays = camera.unproject(xy_px, np.ones(len(xy_px))) - eye_m
    along, u = drawn.camera_from_world[2, :3], np.full((len(xy_px), 2), np.inf)
    dioptres = np.full(len(xy_px), np.median(movable.dioptres))
    for _ in range(5):
        # The point of the ray whose depth in the drawn camera is 1 / dioptres.
        eye_depth_m = along @ eye_m + drawn.camera_from_world[2, 3]
        points_m = eye_m + ((1.0 / dioptres - eye_depth_m) / (rays @ along))[:, None] * rays
        u, _ = drawn.project(points_m)
        inside = np.clip(u / GRID_PX, 0.5, np.array(movable.dioptres.shape[::-1]) - 0.5)
        dioptres = bilinear(movable.dioptres[..., None], inside)[:, 0]
    return bilinear(movable.rgba, u).reshape(camera.height_px, camera.width_px, 4)


def bilinear(picture: np.ndarray, xy: np.ndarray) -> np.ndarray:
    """Values at places, pixel centres at +0.5; 0 outside."""
    x, y = xy[:, 0] - 0.5, xy[:, 1] - 0.5
    result = np.zeros((len(xy), picture.shape[2]))
    for i, j in ((0, 0), (0, 1), (1, 0), (1, 1)):
        column, row = np.floor(x) + i, np.floor(y) + j
        weight = np.maximum(1 - np.abs(x - column), 0) * np.maximum(1 - np.abs(y - row), 0)
        inside = (column >= 0) & (row >= 0) & (column < picture.shape[1]) & (row < picture.shape[0])
        result[inside] += weight[inside, None] * picture[row[inside].astype(int), column[inside].astype(int)]
    return result


def test_the_fast_path_agrees_with_its_plain_twin() -> None:
    # Depths from 1.4 to 4 m over the box, smoothly. Between nodes the fast path is bilinear: places differ by up to some 1/100 px.
    columns, rows = np.meshgrid(np.arange(WIDTH // GRID_PX), np.arange(HEIGHT // GRID_PX))
    depth_m = 1.0 / (0.5 + 0.2 * np.sin(columns / 4.0) * np.cos(rows / 5.0))
    turn = np.linalg.inv(looking((0.0, 0.0, 0.0), (0.0, 1.0, 0.0))) @ looking((0.02, -0.01, 0.02), (0.03, 1.0, 0.01))
    new = replace(FRAME, camera_from_world=turn)
    smooth = sum(blob(x, y) for x, y in ((16, 16), (40, 20), (30, 34)))
    movable = layer(smooth, depth_m)
    fast, plain = whole(movable.moved_to(new)), plainly_moved(movable, new)
    assert plain.max() > 0.9 and np.abs(fast - plain).max() < 0.01 and NODE_PX == 4


def test_depth_is_filled_outwards_and_kept_where_it_is_known() -> None:
    weight = np.zeros((16, 24), np.float32)
    weight[4:8, 4:8], weight[4:8, 16:20] = 0.5, 1.0
    values = np.zeros_like(weight)
    values[4:8, 4:8], values[4:8, 16:20] = 2.0, 4.0
    filled = filled_outwards(values * weight, weight)
    assert np.allclose(filled[4:8, 4:8], 2.0) and np.allclose(filled[4:8, 16:20], 4.0)
    # Everywhere else between what is known, nearer to the nearer.
    assert (filled >= 1.999).all() and (filled <= 4.001).all() and filled[6, 2] < 2.5 and filled[6, 22] > 3.5
    assert not filled_outwards(np.zeros((4, 4), np.float32), np.zeros((4, 4), np.float32)).any()
