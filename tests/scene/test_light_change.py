"""What virtual objects change on a real surface: known shadows, mirror images and brightening; both backends; the composite."""

from dataclasses import replace

import numpy as np
import pytest

from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer, opaque, over
from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Environment, Material, Mesh, Scene, SceneRenderer, Texture, emitter, matte, rectangle, sphere, sun
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.light import neutral_environment
from mrbokeh.scene.light_change import LEAST_CHANGE, LightChange, light_change, light_left
from mrbokeh.system.errors import InputError
from tests.scene.test_scene_backends import DARK, rays

LOOKING_DOWN = np.array([[1, 0, 0, 0], [0, 0.8, -0.6, 0], [0, 0.6, 0.8, 3.0], [0, 0, 0, 1.0]])
CAMERA = Camera(120, 68, (97.0, 95.5), (56.3, 35.7), LOOKING_DOWN)
FLOOR_Y_M = 0.6
FLOOR = rectangle((-60, FLOOR_Y_M, 60), (120, 0, 0), (0, 0, -120), Material(), catches_shadow=True)
CENTRE_M, RADIUS_M = np.array([0.1, 0.0, 0.3]), 0.4


def ball(material: Material) -> Scene:
    return Scene((sphere((0.1, 0.0, 0.3), RADIUS_M, material, rows=96),), environment=neutral_environment(1.0))


def mitsuba_tracer(samples: int = 64, most_bounces: int = 6) -> SceneRenderer:
    pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install 'mrbokeh[mitsuba]'")
    from mrbokeh.scene.mitsuba.mitsuba_tracer import MitsubaTracer

    try:
        return MitsubaTracer(samples=samples, most_bounces=most_bounces)
    except InputError as no_compiler:
        pytest.skip(str(no_compiler))


@pytest.fixture(params=[EmbreeRaycaster, mitsuba_tracer], ids=["cast", "traced"])
def renderer(request: pytest.FixtureRequest) -> SceneRenderer:
    return request.param()


def on_floor() -> tuple[np.ndarray, np.ndarray]:
    """(vectors from where pixels see the floor to the middle of the ball, their lengths)."""
    eye, ray = rays(CAMERA)
    to_middle_m = CENTRE_M - (eye + ((FLOOR_Y_M - eye[1]) / ray[..., 1])[..., None] * ray)
    return to_middle_m, np.linalg.norm(to_middle_m, axis=-1)


def view_factor() -> np.ndarray:
    """What share of a floor point's cosine-weighted sky the ball fills: sin^2 of its half angle times the cosine (it is wholly above
    the horizon, for it hangs 0.2 m above the floor)."""
    to_middle_m, distance_m = on_floor()
    return (RADIUS_M / distance_m) ** 2 * -to_middle_m[..., 1] / distance_m


class TestKnownAnswers:
    def test_shadow_of_a_ball_under_a_uniform_sky(self, renderer: SceneRenderer) -> None:
        change = light_change(renderer, ball(matte(0.0, 0.0, 0.0)), CAMERA, FLOOR)
        error = change.ratio[..., 0] - (1.0 - view_factor())
        assert np.abs(error.mean()) < 1e-3
        assert error.std() < 0.005
        assert change.ratio.min() < 0.57
        assert change.added.max() == 0.0
        assert np.allclose(change.alpha, 1.0)

    def test_far_away_nothing_changes_at_all(self, renderer: SceneRenderer) -> None:
        scene = Scene((sphere((0.1, 0.55, 0.3), 0.05, matte(0.4, 0.2, 0.2)),), (sun((0.2, 1.0, 0.1), 2.0),), neutral_environment(0.5))
        change = light_change(renderer, scene, CAMERA, FLOOR)
        far = np.hypot(on_floor()[0][..., 0], on_floor()[0][..., 2]) > 1.0
        assert far.sum() > 2000
        assert (change.ratio[far] == 1.0).all()
        assert (change.added[far] == 0.0).all()
        assert change.ratio[~far].min() < 0.7
        layer = change.as_layer(np.full((68, 120, 3), 0.3, np.float32))
        assert (layer.alpha[far] == 0).all()
        assert np.isinf(layer.depth_m[far]).all()

    def test_sun_and_sky_share_the_shadow(self, renderer: SceneRenderer) -> None:
        # The core of the sun's shadow keeps the sky but for what the ball hides: (pi (1 - F)) / (pi + E cos).
        direction = np.array([0.5, 1.0, 0.3]) / np.linalg.norm([0.5, 1.0, 0.3])
        change = light_change(renderer, ball(matte(0.0, 0.0, 0.0)).with_lights(sun(tuple(direction), 4.0)), CAMERA, FLOOR)
        to_middle_m, _ = on_floor()
        apart = np.linalg.norm(to_middle_m + (to_middle_m @ -direction)[..., None] * direction, axis=-1)
        core, outside = apart < 0.8 * RADIUS_M, apart > 1.2 * RADIUS_M
        arriving = np.pi + 4.0 * direction[1]
        hidden = np.pi * view_factor() + np.where(core, 4.0 * direction[1], 0.0)
        assert core.sum() > 150
        for where in (core, outside):
            error = (change.ratio[..., 0] - (1.0 - hidden / arriving))[where]
            assert abs(error.mean()) < 1.5e-3
            assert error.std() < 0.01

    def test_each_light_has_a_shadow_of_its_own_or_none(self) -> None:
        """Red light from the left and blue from the right, which throws no shadow: only red is lost, and `light_left` agrees."""
        red, blue = sun((0.6, 1.0, 0.2), (3.0, 0.0, 0.0)), sun((-0.6, 1.0, 0.2), (0.0, 0.0, 3.0))
        lit = ball(matte(0.0, 0.0, 0.0)).with_lights(red, replace(blue, casts_shadow=False))
        scene = replace(lit, environment=DARK)
        change = light_change(EmbreeRaycaster(), scene, CAMERA, FLOOR)
        assert change.ratio[..., 0].min() == 0.0 and (change.ratio[..., 0] < 0.5).sum() > 100
        assert change.ratio[..., 2].min() == 1.0
        alone = light_left(scene, CAMERA, FLOOR, np.arange(120 * 68)).reshape(change.ratio.shape)
        np.testing.assert_allclose(alone, change.ratio, atol=1e-6)

    def test_nothing_to_see_changes_nothing(self, renderer: SceneRenderer) -> None:
        for change in (light_change(renderer, Scene(), CAMERA, FLOOR), light_change(renderer, ball(matte(0, 0, 0)), CAMERA, _behind())):
            assert change.ratio.min() == 1.0
            assert change.added.max() == 0.0


def _behind() -> Mesh:
    return FLOOR.transformed(np.array([[1, 0, 0, 0], [0, 1, 0, -30.0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))


class TestLightFromObjects:
    def test_glowing_ball_brightens_the_floor(self) -> None:
        # Irradiance of a ball of radiance L is pi L F, so a matte floor shows albedo L F more.
        scene = replace(ball(emitter(4.0, 2.0, 1.0)), environment=DARK).with_lights(sun((0.0, 1.0, 0.0), 1.0))
        change = light_change(mitsuba_tracer(), scene, CAMERA, FLOOR, matte(0.3, 0.3, 0.3))
        expected = 0.3 * view_factor()[..., None] * np.array([4.0, 2.0, 1.0])
        assert np.abs((change.added - expected).mean((0, 1))).max() < 2e-3 * expected.max()
        assert np.sqrt(((change.added - expected) ** 2).mean()) < 0.01 * expected.max()

    def test_mirror_shows_the_ball_upside_down(self) -> None:
        scene = replace(ball(emitter(3.0, 3.0, 3.0)), environment=neutral_environment(0.01))
        mirror = Material(base_color=(0.9, 0.9, 0.9, 1.0), metallic=1.0, roughness=0.0)
        change = light_change(mitsuba_tracer(samples=16), scene, CAMERA, FLOOR, mirror)
        eye, ray = rays(CAMERA)
        # Where the eye below the floor (mirrored) sees the ball.
        below, down = eye * [1, -1, 1] + [0, 2 * FLOOR_Y_M, 0], ray * [1, -1, 1]
        along = ((CENTRE_M - below) * down).sum(-1) / (down**2).sum(-1)
        image = np.linalg.norm(CENTRE_M - below - along[..., None] * down, axis=-1) < RADIUS_M
        lit = change.added[..., 0] > 1.35
        assert image.sum() > 300
        assert (image & lit).sum() / (image | lit).sum() > 0.95
        assert np.median(change.added[image]) == pytest.approx(0.9 * 3.0, rel=0.01)
        # The image takes the place of the sky's.
        assert np.median(change.ratio[image]) == pytest.approx(0.0, abs=0.02)

    def test_red_ball_bleeds_onto_a_white_floor(self) -> None:
        change = light_change(mitsuba_tracer(), ball(matte(0.8, 0.1, 0.1)), CAMERA, FLOOR, matte(0.8, 0.8, 0.8))
        under = view_factor() > 0.3
        red, green, _ = change.added[under].mean(0)
        assert red > 5 * green > 0


class TestBackendsAgree:
    def test_on_a_matte_floor(self) -> None:
        top = np.linspace(0.2, 1.5, 16, dtype=np.float32)[:, None, None] * np.array([1.0, 0.8, 0.6], np.float32)
        sky = Environment(np.ascontiguousarray(np.broadcast_to(top[::-1], (16, 32, 3))))
        scene = Scene(ball(matte(0.0, 0.0, 0.0)).meshes, (sun((0.5, 1.0, 0.3), 2.0),), sky)
        cast, traced = (light_change(each, scene, CAMERA, FLOOR) for each in (EmbreeRaycaster(), mitsuba_tracer()))
        assert np.abs((cast.ratio - traced.ratio).mean((0, 1))).max() < 2e-3
        # The rest is noise and the rim of the sun's shadow, whose pixels are drawn by other points.
        assert np.sqrt(((cast.ratio - traced.ratio) ** 2).mean()) < 0.02
        assert np.array_equal(cast.depth_m, traced.depth_m)


class TestComposite:
    def change(self) -> tuple[LightChange, np.ndarray]:
        rng = np.random.default_rng(3)
        ratio, added, plate = (rng.uniform(0, 1, (9, 7, 3)).astype(np.float32) for _ in range(3))
        ratio[:3], added[:3], added[3:5], ratio[5:7] = 1.0, 0.0, 0.0, 1.0
        return LightChange(ratio, added, np.ones((9, 7), np.float32), np.full((9, 7), 2.0, np.float32)), plate

    def test_over_the_plate_it_multiplies_and_adds_and_an_even_loss_needs_no_plate(self) -> None:
        change, plate = self.change()
        layer = change.as_layer(plate)
        rgb = over(layer, opaque(plate, np.full((9, 7), 3.0, np.float32))).rgb
        assert np.allclose(rgb, plate * change.ratio + change.added, atol=1e-6)
        assert np.array_equal(rgb[:3], plate[:3])
        assert layer.rgb.min() >= 0
        assert layer.alpha[5:7].min() >= LEAST_CHANGE  # light alone is covered a little, so that no renderer drops it
        assert np.array_equal(np.isinf(layer.depth_m), layer.alpha == 0)
        even = change.evenly()
        rgb = over(even.as_layer(np.zeros_like(plate)), opaque(plate, np.full((9, 7), 3.0, np.float32))).rgb
        share = change.ratio @ np.array([0.2126, 0.7152, 0.0722], np.float32)
        # Where nothing is lost but light is added, a thousandth of the plate is covered.
        assert np.allclose(rgb, plate * share[..., None] + change.added, atol=1.1 * LEAST_CHANGE)
        assert np.array_equal(rgb[:3], plate[:3])
        with pytest.raises(InputError, match="shape"):
            self.change()[0].as_layer(np.zeros((3, 3, 3), np.float32))

    def test_object_on_a_photograph_is_the_picture_of_both(self) -> None:
        # Real: a painted, slightly glossy table under sun and sky. Virtual: a red ball lying on it. The plate is the table alone; its
        # layers come from a guess of the table (grey of its mean albedo); truth is both in one picture. The light behind the
        # ball's soft edge is the plate's, as in any composite.
        paint = np.random.default_rng(0).uniform(0.3, 0.7, (12, 12, 3)).astype(np.float32)
        table = replace(FLOOR, catches_shadow=False, uvs=FLOOR.uvs * np.float32(20.0))
        painted = Material(base_color_texture=Texture(paint), metallic=0.0, roughness=0.4, double_sided=True)
        lying = sphere((0.1, FLOOR_Y_M - RADIUS_M, 0.3), RADIUS_M, matte(0.7, 0.1, 0.1), rows=96)
        real = Scene((replace(table, material=painted),), (sun((0.5, 1.0, 0.3), 2.0),), neutral_environment(0.6))
        exact, tracer = mitsuba_tracer(samples=256), mitsuba_tracer(samples=64)
        truth, plate = exact.render(replace(real, meshes=(*real.meshes, lying)), CAMERA).rgb, exact.render(real, CAMERA).rgb
        guess = replace(painted, base_color_texture=None, base_color=(0.5, 0.5, 0.5, 1.0))
        virtual = replace(real, meshes=(lying,))
        floor = light_change(tracer, virtual, CAMERA, FLOOR, guess).as_layer(plate)
        front: Layer = tracer.render_beside(virtual, CAMERA, [replace(FLOOR, material=guess)])  # type: ignore[attr-defined]
        composite = over(front, over(floor, opaque(plate, np.full(plate.shape[:2], 9.0, np.float32)))).rgb
        assert psnr(composite, truth) > 42.0
        assert psnr(composite, truth, mask=front.alpha == 0) > 50.0
        without = over(front, opaque(plate, np.full(plate.shape[:2], 9.0, np.float32))).rgb
        assert psnr(composite, truth) > psnr(without, truth) + 10.0
