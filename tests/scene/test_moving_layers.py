"""Motion blur of virtual objects: closed forms, and the slow average of many moments as the truth."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.distortion import LensDistortion, distorted, overscan_camera
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import MOTION, drawn_out, motion_of
from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Scene, emitter, rectangle, shadow_catcher, sun, world_from_scene_placing
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.gltf.gltf_loader import GltfAsset, load_glb
from mrbokeh.scene.moving_layers import FilmedScene, ShutterTiming, accumulated, moving_layer, moving_shadow_layer
from mrbokeh.scene.moving_layers.moving_layer import MotionQuality, ShadowCatcher, SurfacePoints, paths_of
from tests.support.refusals import refused

OBJECTS = Path(__file__).resolve().parents[2] / "mrbokeh" / "demo_data" / "objects"
CAMERA = Camera(160, 107, (173.0, 170.0), (79.0, 55.0))
SHUTTER = ShutterTiming(24.0)
MIDDLE_M = np.array([0.0, 0.0, 2.0])
RENDERER = EmbreeRaycaster(threads=1)


def pose(turn_rad: float, shift_m: np.ndarray) -> np.ndarray:
    """Turned about the vertical through MIDDLE_M, then shifted."""
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    result = np.eye(4)
    result[:3, :3] = [[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]]
    result[:3, 3] = MIDDLE_M - result[:3, :3] @ MIDDLE_M + shift_m
    return result


def moving(scene: Scene, velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0), turn_rad_s: float = 0.0) -> Callable[[float], Scene]:
    return lambda time_s: scene.transformed(pose(turn_rad_s * time_s, np.asarray(velocity_m_s) * time_s))


def panning(rate_rad_s: float = 0.0, velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Callable[[float], Camera]:
    def camera_at(time_s: float) -> Camera:
        turn = pose(-rate_rad_s * time_s, np.zeros(3))
        turn[:3, 3] = np.asarray(velocity_m_s) * time_s
        return replace(CAMERA, camera_from_world=turn)

    return camera_at


def board(width_m: float = 0.3, height_m: float = 0.3) -> Scene:
    """An even emitter, upright, 2 m before the camera."""
    mesh = rectangle((-width_m / 2, -height_m / 2, 2.0), (width_m, 0.0, 0.0), (0.0, height_m, 0.0), emitter(1.0, 0.5, 0.25))
    return Scene((mesh,))


@pytest.fixture(scope="module")
def alien() -> Scene:
    scene = load_glb(OBJECTS / "alien.glb").without_lights()
    return scene.transformed(world_from_scene_placing(scene, (0.0, 0.3, 2.0), 0.6)).with_lights(sun((0.3, 1.0, 0.5), 3.0))


def drawn(layer: Layer) -> np.ndarray:
    """(H, W, 4) as the renderers draw it out, without any lens blur."""
    values = np.concatenate([layer.rgb, layer.alpha[..., None]], axis=2)
    if MOTION not in layer.extra:
        return values
    return drawn_out(values, np.zeros_like(layer.alpha), motion_of(layer.extra[MOTION], layer.alpha))[0]


def motion_at(layer: Layer, x: int, y: int) -> np.ndarray:
    assert layer.alpha[y, x] == 1.0
    return layer.extra[MOTION][y, x]


def test_motion_of_a_board_is_that_of_its_points() -> None:
    """3 m/s across at 2 m for 1/48 s: 173 * 3 / 2 / 48 px; 1 m/s down: 170 / 2 / 48 px."""
    layer = moving_layer(RENDERER, FilmedScene(moving(board(), (3.0, 1.0, 0.0)), panning(), SHUTTER), 0.0)
    np.testing.assert_allclose(motion_at(layer, 79, 55), [173.0 * 3.0 / 96.0, 170.0 / 96.0], rtol=1e-4)


def test_a_panning_camera_moves_what_is_still() -> None:
    """Turned by 1.5 rad/s for 1/48 s to the right: the middle moves left by 2 f tan(1.5 / 96), a place beside it by more."""
    board_3_m = Scene(tuple(mesh.transformed(np.diag([4.0, 4.0, 1.0, 1.0])) for mesh in board().meshes))
    layer = moving_layer(RENDERER, FilmedScene(lambda _: board_3_m, panning(1.5), SHUTTER), 0.0)
    assert MOTION in layer.extra
    middle = motion_at(layer, 78, 54)
    across = 0.5 / 173.0  # this pixel's centre lies half a pixel off the axis
    expected = 173.0 * (np.tan(np.arctan(-across) - 1.5 / 96) - np.tan(np.arctan(-across) + 1.5 / 96))
    assert middle[0] == pytest.approx(expected, rel=2e-3)
    assert abs(motion_at(layer, 30, 54)[0]) > abs(middle[0]) * 1.02


def test_a_full_turn_of_the_shutter_draws_twice_as_long_as_half_of_one(alien: Scene) -> None:
    filmed = FilmedScene(moving(alien, (2.0, 0.5, 0.0)), panning(), SHUTTER)
    shutters = [replace(SHUTTER, angle_deg=angle) for angle in (180.0, 360.0)]
    half, full = (moving_layer(RENDERER, replace(filmed, shutter=each), 0.0) for each in shutters)
    np.testing.assert_allclose(full.extra[MOTION], 2.0 * half.extra[MOTION], rtol=1e-4, atol=1e-4)
    np.testing.assert_array_equal(full.rgb, half.rgb)


def test_a_closed_shutter_and_a_still_scene_stay_bit_for_bit(alien: Scene) -> None:
    sharp = RENDERER.render(alien, CAMERA)
    moves = moving(alien, (2.0, 0.5, 0.0))
    still = FilmedScene(lambda _: alien, lambda _: CAMERA, replace(SHUTTER, readout_s=0.02))
    copies = FilmedScene(moving(alien), panning(), SHUTTER)
    closed = FilmedScene(lambda time_s: alien if time_s == 0.0 else moves(time_s), panning(), replace(SHUTTER, angle_deg=0.0))
    for filmed in (still, copies, closed):
        layer = moving_layer(RENDERER, filmed, 0.0)
        assert not layer.extra
        for name in ("rgb", "alpha", "depth_m"):
            np.testing.assert_array_equal(getattr(layer, name), getattr(sharp, name))


ROLLING = replace(SHUTTER, angle_deg=90.0, readout_s=0.03)
Case = tuple[tuple[float, float, float], float, float, ShutterTiming, float, float]
CASES: dict[str, Case] = {
    # object m/s, turn rad/s, pan rad/s, shutter, least PSNR in dB in the object's region, least gain over the sharp picture
    "object": ((4.0, 1.0, 0.0), 0.0, 0.0, SHUTTER, 39.0, 15.0),
    "pan": ((0.0, 0.0, 0.0), 0.0, 1.5, SHUTTER, 45.0, 20.0),
    "object turning while the camera pans": ((0.0, 0.0, 0.0), 3.0, 1.5, SHUTTER, 41.0, 15.0),
    # What moves by a pixel or less is as sharp as before: drawing out softens it a little.
    "tracked": ((3.0, 0.0, 0.0), 0.0, 1.5, SHUTTER, 42.0, -4.0),
    "fast turn, by accumulation": ((0.0, 0.0, 0.0), 60.0, 0.0, SHUTTER, 45.0, 20.0),
}
ROLLING_CASES: dict[str, Case] = {
    "across": ((2.5, 0.6, 0.0), 0.0, 0.0, ROLLING, 30.0, 10.0),
    "with the readout": ((0.0, 2.5, 0.0), 0.0, 0.0, ROLLING, 38.0, 12.0),
    "against the readout": ((0.0, -2.5, 0.0), 0.0, 0.0, ROLLING, 36.0, 12.0),
    "pan": ((0.0, 0.0, 0.0), 0.0, 1.0, ROLLING, 32.0, 12.0),
}


def agreement(filmed: FilmedScene, samples: int) -> tuple[float, float, bool]:
    """PSNR in dB of (the layer, the sharp picture) against the average, over what any of them shows; whether it has channels."""
    layer, truth = moving_layer(RENDERER, filmed, 0.0), accumulated(RENDERER.render, filmed, 0.0, samples, band_px=3)
    middle_s = filmed.shutter.middle_s(0.0)
    sharp = RENDERER.render(filmed.scene_at(middle_s), filmed.camera_at(middle_s))
    expected = drawn(truth)
    shown = (truth.alpha > 0) | (sharp.alpha > 0)
    scores = [psnr(each, expected, mask=shown) for each in (drawn(layer), drawn(sharp))]
    return scores[0], scores[1], MOTION in layer.extra


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_one_picture_with_motion_is_as_many_pictures_averaged(name: str, alien: Scene) -> None:
    """Margins of about 3 dB below what was measured; what is left are light that moves over the surface, surfaces that come to
    be seen during the shutter, and the half pixel by which drawing out along a path softens."""
    _check(alien, CASES[name], samples=40, has_channels="accumulation" not in name)


@pytest.mark.slow
@pytest.mark.parametrize("name", ROLLING_CASES)
def test_rolled_rows_are_as_bands_at_their_own_times(name: str, alien: Scene) -> None:
    """The truth itself comes in bands of 3 rows, between which it jumps by up to a fifth of a pixel. Measured 32 to 40 dB."""
    _check(alien, ROLLING_CASES[name], samples=16, has_channels=True)


def _check(scene: Scene, case: Case, samples: int, has_channels: bool) -> None:
    velocity_m_s, turn_rad_s, pan_rad_s, shutter, least_db, gain_db = case
    still = not any(velocity_m_s) and not turn_rad_s
    scene_at = (lambda _: scene) if still else moving(scene, velocity_m_s, turn_rad_s)
    fast, sharp, moved = agreement(FilmedScene(scene_at, panning(pan_rad_s), shutter), samples)
    assert moved == has_channels and fast > least_db and fast > sharp + gain_db


@pytest.mark.parametrize(("pan_rad_s", "least_db", "gain_db"), [(0.0, 35.0, 3.0), (1.5, 36.0, 12.0)])
@pytest.mark.slow
def test_a_running_fox(shared_data: Path, pan_rad_s: float, least_db: float, gain_db: float) -> None:
    """A skin: every pixel follows its triangle. Its legs run unevenly, by at most 0.36 px here."""
    asset = GltfAsset(shared_data / "objects" / "Fox.glb")
    placing = world_from_scene_placing(asset.scene_at(0.0, "Run"), (0.0, 0.3, 2.0), 0.6, 1.2)

    def scene_at(time_s: float) -> Scene:
        return asset.scene_at(0.3 + time_s, "Run").without_lights().transformed(placing).with_lights(sun((0.3, 1.0, 0.5), 3.0))

    fast, sharp, has_channels = agreement(FilmedScene(scene_at, panning(pan_rad_s), SHUTTER), samples=24)
    assert has_channels and fast > least_db and fast > sharp + gain_db


def test_things_that_move_differently_are_told_apart_and_bodies_as_their_triangles(alien: Scene) -> None:
    """Two boards side by side, one of which moves: each pixel follows its own triangle."""
    left, right = (board(0.2, 0.4).transformed(pose(0.0, np.array([x, 0.0, 0.0]))) for x in (-0.3, 0.3))

    def scene_at(time_s: float) -> Scene:
        return replace(left, meshes=(*left.meshes, *moving(right, (0.0, 2.0, 0.0))(time_s).meshes))

    layer = moving_layer(RENDERER, FilmedScene(scene_at, panning(), SHUTTER), 0.0)
    np.testing.assert_allclose(motion_at(layer, 53, 55), [0.0, 0.0], atol=1e-4)
    np.testing.assert_allclose(motion_at(layer, 105, 55), [0.0, 170.0 * 2.0 / 96.0], rtol=1e-3)
    # Both ways for the same rigid motion, at every pixel whose depth is that of its middle.
    layer, moved = RENDERER.render(alien, CAMERA), alien.transformed(pose(0.2, np.array([0.1, -0.05, 0.2])))
    inside = layer.alpha == 1.0
    points_m = CAMERA.unproject(CAMERA.pixel_centres_px()[inside], layer.depth_m[inside].astype(np.float64))
    points = SurfacePoints(alien, np.zeros(3), points_m)
    as_body, by_triangles = points.at(moved), points.following_triangles(moved.drawn_meshes)
    assert as_body is not None and by_triangles is not None
    found = np.isfinite(by_triangles).all(axis=1)
    assert found.mean() > 0.97
    assert np.percentile(np.linalg.norm(as_body - by_triangles, axis=1)[found], 99.0) < 1e-5
    np.testing.assert_array_equal(points.at(alien), points_m)
    np.testing.assert_array_equal(points.at(moved, 7), as_body[::7])
    assert points.following_triangles(replace(alien, meshes=(*alien.meshes, *board().meshes)).drawn_meshes) is None


def test_a_wheel_is_averaged_once_its_paths_bend() -> None:
    """A point at r pixels that turns by a bends its path by r (1 - cos(a / 2)): the board's corner lies at 39 px or so."""
    wide = board(0.6, 0.6)

    def spinning(rate_rad_s: float) -> FilmedScene:
        def scene_at(time_s: float) -> Scene:
            cosine, sine = np.cos(rate_rad_s * time_s), np.sin(rate_rad_s * time_s)
            turn = np.eye(4)
            turn[:2, :2] = [[cosine, -sine], [sine, cosine]]
            return wide.transformed(turn)

        return FilmedScene(scene_at, panning(), SHUTTER)

    layer = RENDERER.render(wide, CAMERA)
    for angle_rad in (0.15, 0.5):
        paths = paths_of(layer, spinning(48.0 * angle_rad), 0.0, 1.0 / 48.0)
        assert paths is not None
        corner_px = 0.3 * np.sqrt(2.0) / 2.0 * 171.5
        assert paths.bend_px == pytest.approx(corner_px * (1.0 - np.cos(angle_rad / 2.0)), rel=0.1)
    assert MOTION in moving_layer(RENDERER, spinning(48.0 * 0.15), 0.0).extra
    assert MOTION not in moving_layer(RENDERER, spinning(48.0 * 0.5), 0.0).extra
    assert MOTION not in moving_layer(RENDERER, spinning(48.0 * 2.0 * np.pi), 0.0).extra  # back at its place in the end
    assert MOTION in moving_layer(RENDERER, spinning(48.0 * 0.5), 0.0, MotionQuality(most_bend_px=3.0)).extra


def test_rows_are_seen_one_after_the_other_within_overscan_as_well() -> None:
    """A line upright that moves right by 200 px/s, read in 0.05 s, leans by 10 px over the frame; its middle row is on time."""
    metres_per_px = 2.0 / 173.0
    bar = board(4.0 * metres_per_px, 4.0)
    shutter = replace(SHUTTER, angle_deg=0.0, readout_s=0.05)
    filmed = FilmedScene(moving(bar, (200.0 * metres_per_px, 0.0, 0.0)), panning(), shutter)
    layer = moving_layer(RENDERER, filmed, -0.025)
    assert not layer.extra
    x = np.arange(160) + 0.5
    middle = (layer.alpha * x).sum(axis=1) / layer.alpha.sum(axis=1)
    np.testing.assert_allclose(middle, 79.0 + 10.0 * ((np.arange(107) + 0.5) / 107.0 - 0.5), atol=0.05)
    # The upper edge of the plate is read first, wherever it lies in the overscanned picture.
    wide = overscan_camera(CAMERA, LensDistortion.of("opencv", k1=-0.2))
    shutter = replace(ROLLING).within(wide, CAMERA)
    top = wide.principal_px[1] - CAMERA.principal_px[1]
    assert top > 2.0
    assert shutter.row_delay_s(top, wide.height_px) == pytest.approx(0.0)
    assert shutter.row_delay_s(top + 107.0, wide.height_px) == pytest.approx(0.03)
    assert shutter.row_delay_s(0.0, wide.height_px) < 0.0


@pytest.mark.slow
def test_rolled_rows_of_a_board_are_as_bands_of_one_row() -> None:
    """Even light, so that only the geometry counts: every row of the truth at its own time. Where light lies and how much there
    is agrees; edges are softer, by the half pixel of reading the picture once more and drawing it out."""
    filmed = FilmedScene(moving(board(), (2.5, 0.6, 0.0)), panning(), ROLLING)
    fast = drawn(moving_layer(RENDERER, filmed, -0.015))[..., 3]
    truth = accumulated(RENDERER.render, filmed, -0.015, 8, band_px=1).alpha
    x, rows = np.arange(160) + 0.5, np.flatnonzero(truth.max(axis=1) > 0.9)
    assert len(rows) > 20
    middles = [(each[rows] * x).sum(axis=1) / each[rows].sum(axis=1) for each in (fast, truth)]
    assert np.ptp(middles[1]) > 1.0
    np.testing.assert_allclose(*middles, atol=0.1)
    assert fast.sum() == pytest.approx(truth.sum(), rel=5e-3)
    assert psnr(fast, truth, mask=truth > 0) > psnr(RENDERER.render(board(), CAMERA).alpha, truth, mask=truth > 0) + 6.0


def test_what_runs_with_the_readout_is_drawn_longer() -> None:
    """Rows run at 107 px / 0.05 s; a board at a quarter of that stays open 1 / (1 - 1/4) as long."""
    speed_px_s = 0.25 * 107.0 / 0.05
    filmed = FilmedScene(moving(board(), (0.0, speed_px_s * 2.0 / 170.0, 0.0)), panning(), replace(SHUTTER, angle_deg=36.0, readout_s=0.05))
    layer = moving_layer(RENDERER, filmed, -0.025)
    exposure_s = 0.1 / 24.0
    np.testing.assert_allclose(motion_at(layer, 79, 55), [0.0, speed_px_s * exposure_s / 0.75], atol=2e-2)
    assert layer.alpha[:, 79].sum() == pytest.approx(0.3 * 85.0 / 0.75, abs=0.2)


def test_a_distorted_plate_sees_motion_bent_as_the_lens_bends_it(alien: Scene) -> None:
    """Moved, then distorted, is the average of distorted moments."""
    distortion = LensDistortion.of("opencv", k1=-0.25, k2=0.08)
    scene_at, wide = moving(alien, (3.0, -1.0, 0.0)), overscan_camera(CAMERA, distortion)
    filmed = FilmedScene(scene_at, lambda _: wide, SHUTTER)
    layer = distorted(moving_layer(RENDERER, filmed, 0.0), wide, CAMERA, distortion)
    moments = ((np.arange(32) + 0.5) / 32 - 0.5) / 48.0
    sharp = [distorted(RENDERER.render(scene_at(t), wide), wide, CAMERA, distortion) for t in moments.tolist()]
    truth = np.mean([drawn(each) for each in sharp], axis=0)
    score, sharp_score = (psnr(drawn(each), truth, mask=truth[..., 3] > 0) for each in (layer, sharp[16]))
    assert score > 38.0 and score > sharp_score + 12.0


def test_the_average_of_moments_is_their_mean_and_shutters_that_cannot_be() -> None:
    """Four moments of a board in even motion, by hand."""
    filmed = FilmedScene(moving(board(), (3.0, 0.0, 0.0)), panning(), SHUTTER)
    by_hand = [RENDERER.render(filmed.scene_at(((k + 0.5) / 4 - 0.5) / 48.0), CAMERA) for k in range(4)]
    mean = accumulated(RENDERER.render, filmed, 0.0, 4)
    np.testing.assert_allclose(mean.rgb, np.mean([each.rgb for each in by_hand], axis=0), atol=1e-6)
    np.testing.assert_allclose(mean.alpha, np.mean([each.alpha for each in by_hand], axis=0), atol=1e-6)
    np.testing.assert_allclose(mean.depth_m[mean.alpha > 0], 2.0, rtol=1e-6)
    assert np.isinf(mean.depth_m[mean.alpha == 0]).all()
    refused("frame rate above 0", ShutterTiming, 0.0)
    refused("0 to 360", ShutterTiming, 24.0, 400.0)
    refused("at least one picture", accumulated, RENDERER.render, FilmedScene(moving(board()), panning(), SHUTTER), 0.0, 0)


LOOKING_DOWN = np.array([[1.0, 0, 0, 0], [0, 0.8, -0.6, 0.9], [0, 0.6, 0.8, 0.8], [0, 0, 0, 1.0]])


def shadow_scene(velocity_m_s: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Callable[[float], Scene]:
    """A board over the ground at y = 0, lit by a sun."""
    flat = rectangle((-0.2, -0.3, 1.3), (0.4, 0.0, 0.0), (0.0, 0.0, 0.4), emitter(1.0, 1.0, 1.0))
    scene = Scene((flat,)).with_lights(sun((0.1, 1.0, 0.1), 3.0))
    return lambda time_s: scene.transformed(pose(0.0, np.asarray(velocity_m_s) * time_s)) if any(velocity_m_s) else scene


@pytest.mark.parametrize(
    ("velocity_m_s", "pan_m_s", "has_channels"),
    [((0.0, 0.0, 0.0), (4.0, 0.0, 0.0), True), ((4.0, 0.0, 0.0), (0.0, 0.0, 0.0), False), ((4.0, 0.0, 0.0), (-4.0, 0.0, 0.0), False)],
)
def test_shadows_move_too(velocity_m_s: tuple[float, float, float], pan_m_s: tuple[float, float, float], has_channels: bool) -> None:
    """With the camera, with the object, and with both so that it stands still in the picture."""

    def camera_at(time_s: float) -> Camera:
        moved = LOOKING_DOWN.copy()
        moved[:3, 3] += np.asarray(pan_m_s) * time_s
        return replace(CAMERA, camera_from_world=moved)

    catcher = ShadowCatcher(shadow_catcher(0.0, (0.0, 1.5), 1.5), 0.8)
    filmed = FilmedScene(shadow_scene(velocity_m_s), camera_at, SHUTTER)
    layer = moving_shadow_layer(RENDERER, filmed, 0.0, catcher, samples=24)
    assert layer.alpha.max() > 0.5
    assert (MOTION in layer.extra) == has_channels
    sharp = moving_shadow_layer(RENDERER, replace(filmed, shutter=replace(SHUTTER, angle_deg=0.0)), 0.0, catcher)
    assert not sharp.extra
    closed, times_s = replace(SHUTTER, angle_deg=0.0), ((np.arange(24) + 0.5) / 24 - 0.5) / 48.0
    still = [FilmedScene(lambda _, t=t: filmed.scene_at(t), lambda _, t=t: filmed.camera_at(t), closed) for t in times_s]
    expected = np.mean([moving_shadow_layer(RENDERER, each, 0.0, catcher).alpha for each in still], axis=0)
    shown = expected > 0
    score, sharp_score = (psnr(drawn(each)[..., 3], expected, mask=shown) for each in (layer, sharp))

    assert score > 36.0
    if has_channels or not any(pan_m_s):
        assert score > sharp_score + 10.0
