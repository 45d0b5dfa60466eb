"""The path tracer: the laws of every backend (asked in means where paths are noisy), and light that surfaces pass on to each other.

16 paths per pixel scatter by about 10 % in uniform light; means over N pixels by 1 / sqrt(N) of that.
"""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("mitsuba", reason="Mitsuba is not installed: pip install 'mrbokeh[mitsuba]'")

from mrbokeh.optics.camera import Camera
from mrbokeh.scene import (
    Environment,
    Light,
    Material,
    Mesh,
    Scene,
    SceneRenderer,
    Texture,
    emitter,
    matte,
    rectangle,
    sphere,
    sun,
    world_from_scene_placing,
)
from mrbokeh.scene.choose import scene_renderer
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.gltf.gltf_loader import load_glb
from mrbokeh.scene.light import directions, neutral_environment, solid_angles_sr
from mrbokeh.scene.mitsuba.mitsuba_tracer import MitsubaTracer
from mrbokeh.system.errors import InputError, MissingExtraError
from tests.scene import test_scene_backends as laws

SMALL = Camera(80, 48, (65.0, 64.0), (37.3, 25.7))
"""Unequal focal lengths and a principal point off the middle."""


@pytest.fixture(scope="module")
def backend() -> SceneRenderer:
    """One path per pixel is enough where nothing is noisy."""
    try:
        return MitsubaTracer(samples=1)
    except InputError as no_compiler:
        pytest.skip(str(no_compiler))


def like(backend: SceneRenderer, samples: int, most_bounces: int = 6) -> MitsubaTracer:
    """The same kind of backend with other settings."""
    assert isinstance(backend, MitsubaTracer)
    return MitsubaTracer(samples, most_bounces)


class TestDepth(laws.TestDepth):
    """Nothing of it is noisy."""

    @pytest.mark.slow
    def test_sphere_within_a_tenth_of_a_millimetre(self, backend: SceneRenderer) -> None:
        super().test_sphere_within_a_tenth_of_a_millimetre(backend)

    @pytest.mark.slow
    def test_tilted_plane_within_a_tenth_of_a_millimetre(self, backend: SceneRenderer) -> None:
        super().test_tilted_plane_within_a_tenth_of_a_millimetre(backend)


class TestGeometry(laws.TestGeometry):
    @pytest.mark.slow
    def test_alpha_edges_against_sixteen_by_sixteen_samples(self, backend: SceneRenderer) -> None:
        super().test_alpha_edges_against_sixteen_by_sixteen_samples(backend)

    def test_rays_meet_what_the_camera_projects_there(self, backend: SceneRenderer) -> None:
        # A screen 3 m away that shines with its own coordinates (linear in x and y, so a pixel's mean is its centre's value) tells
        # where the paths of a pixel hit: 64 stratified ones must be right within 0.05 pixels.
        ramp = (np.arange(256, dtype=np.float32) + 0.5) / 256
        texels = np.stack([*np.meshgrid(ramp, ramp), np.zeros((256, 256), np.float32)], axis=-1).astype(np.float32)
        screen = replace(laws.facing_square(emitter(1.0, 1.0, 1.0), 3.0, 3.0), name="screen")
        screen = replace(screen, material=replace(screen.material, emissive_texture=Texture(texels, ("clamp", "clamp"))))
        rgb = like(backend, samples=64, most_bounces=0).render(Scene((screen,), environment=laws.DARK), SMALL).rgb
        seen_m = np.concatenate([rgb[..., :2] * 6.0 - 3.0, np.full((*rgb.shape[:2], 1), 3.0)], axis=-1).astype(np.float64)
        error_px = SMALL.project(seen_m)[0] - SMALL.pixel_centres_px()
        assert np.abs(error_px.mean((0, 1))).max() < 0.002
        assert np.sqrt((error_px**2).sum(-1)).max() < 0.05


class TestLight(laws.TestLight):
    def test_a_bare_object_is_visible(self, backend: SceneRenderer) -> None:
        square = laws.facing_square(matte(0.2, 0.4, 0.8))
        assert np.allclose(like(backend, samples=16).render(Scene((square,)), SMALL).rgb.mean((0, 1)), [0.2, 0.4, 0.8], rtol=5e-3)

    def test_point_and_spot_fall_off_with_the_square(self, backend: SceneRenderer) -> None:
        # Paths go through all of a pixel, so the truth is its mean over 16x16 points.
        camera, fine = Camera(41, 31, (40.0, 40.0), (20.5, 15.5)), Camera(656, 496, (640.0, 640.0), (328.0, 248.0))
        point = Light("point", (8.0, 4.0, 2.0), position_m=(0.3, 0.2, 0.0))
        spot = replace(point, kind="spot", direction=(0.0, 0.0, 1.0), inner_cone_rad=0.3, outer_cone_rad=0.5)
        at_m = fine.unproject(fine.pixel_centres_px(), np.full((496, 656), 2.0)).reshape(-1, 3)
        for light in (point, spot):
            towards, _distance_m, irradiance = light.arriving_at(at_m)
            truth = (0.5 / np.pi * -towards[:, 2:] * irradiance).reshape(31, 16, 41, 16, 3).mean((1, 3))
            seen = like(backend, samples=64).render(Scene((laws.facing_square(matte(0.5, 0.5, 0.5)),), (light,)), camera).rgb
            assert np.abs(seen - truth).max() < 3e-3 * truth.max()

    def test_hard_shadow_falls_on_another_object(self, backend: SceneRenderer) -> None:
        super().test_hard_shadow_falls_on_another_object(like(backend, samples=16, most_bounces=1))

    def test_rectangular_lamp_lights_a_plane_as_its_view_factor_says(self, backend: SceneRenderer) -> None:
        # Howell, A Catalog of Radiation Heat Transfer Configuration Factors, B-4: an element below a corner of a parallel
        # rectangle; a lamp of 2 x 1.2 m 0.8 m in front of the wall is four such rectangles around the point before its middle.
        a, b = 1.0 / 0.8, 0.6 / 0.8
        corner = (a / np.hypot(1, a) * np.arctan(b / np.hypot(1, a)) + b / np.hypot(1, b) * np.arctan(a / np.hypot(1, b))) / (2 * np.pi)
        wall = laws.facing_square(matte(0.5, 0.5, 0.5), 2.0)
        lamp = rectangle((1.0, -0.6, 1.2), (-2.0, 0, 0), (0, 1.2, 0), replace(emitter(3.0, 2.0, 1.0), double_sided=False))
        # Single-sided, turned to the wall: it does not hide the wall from the camera.
        narrow = Camera(16, 16, (2000.0, 1900.0), (8.0, 8.0))
        seen = like(backend, samples=64, most_bounces=1).render(Scene((wall, lamp), environment=laws.DARK), narrow).rgb.mean((0, 1))
        assert np.allclose(seen, 0.5 * 4 * corner * np.array([3.0, 2.0, 1.0]), rtol=5e-3)

    def test_only_the_bright_part_of_a_textured_lamp_shines(self, backend: SceneRenderer) -> None:
        # A lamp whose texture is black on one half is a lamp of half the size; so for drawn points and for paths that find it.
        wall = laws.facing_square(matte(0.5, 0.5, 0.5), 2.0)
        half = np.zeros((4, 256, 3), np.float32)
        half[:, :128] = 1.0
        glow = replace(emitter(3.0, 3.0, 3.0), double_sided=False)
        painted = rectangle((1.0, -0.6, 1.2), (-2.0, 0, 0), (0, 1.2, 0), replace(glow, emissive_texture=Texture(half, ("clamp", "clamp"))))
        plain = rectangle((1.0, -0.6, 1.2), (-1.0, 0, 0), (0, 1.2, 0), glow)
        seen, same = (
            like(backend, samples=64, most_bounces=1).render(Scene((wall, lamp), environment=laws.DARK), SMALL).rgb
            for lamp in (painted, plain)
        )
        assert seen.mean() == pytest.approx(same.mean(), rel=0.005)
        blocks, other_blocks = (each.reshape(6, 8, 10, 8, 3).mean((1, 3)) for each in (seen, same))
        assert np.allclose(blocks, other_blocks, rtol=0.05)


class TestTransparency(laws.TestTransparency):
    def test_blend_is_over_front_to_back(self, backend: SceneRenderer) -> None:
        def pane(red: float, green: float, blue: float, alpha: float, depth_m: float) -> Mesh:
            return laws.facing_square(Material(base_color=(red, green, blue, alpha), alpha_mode="BLEND", unlit=True), depth_m)

        layer = like(backend, samples=64).render(Scene((pane(0, 1, 0, 0.25, 3.0), pane(1, 0, 0, 0.4, 2.0))), SMALL)
        assert np.allclose(layer.rgb.mean((0, 1)), [0.4, 0.6 * 0.25, 0.0], atol=2e-3)
        assert np.allclose(layer.alpha, 1 - 0.6 * 0.75, atol=1e-6)
        assert np.allclose(layer.depth_m, 3.0, atol=1e-5)


class TestTextures(laws.TestTextures):
    """Nothing of it is noisy."""


class TestShadowMask(laws.TestShadowMask):
    """The ray caster's."""


@pytest.mark.usefixtures("backend")
class TestEnvironment:
    @pytest.mark.parametrize("panorama", [laws.colourful_panorama, laws.sunny_panorama])
    def test_grey_plane_shows_the_irradiance_integral(self, panorama: object) -> None:
        environment = Environment(panorama()).turned(1.1)  # type: ignore[operator]
        light = environment.radiance * solid_angles_sr(*environment.radiance.shape[:2])[..., None]
        towards = directions(*environment.radiance.shape[:2]) @ environment.world_from_environment.T
        camera = Camera(16, 12, (30.0, 30.0), (8.0, 6.0))
        for yaw, pitch in ((0.4, -0.5), (-2.1, 0.9), (-0.91, 0.0)):
            view = laws.turned_camera(camera, yaw, pitch, (0.0, 0.0, 0.0))
            square = rectangle((-3, -3, 2), (6, 0, 0), (0, 6, 0), matte(0.5, 0.5, 0.5)).transformed(view.world_from_camera)
            truth = 0.5 / np.pi * (light * np.maximum(towards @ -view.world_from_camera[:3, 2], 0.0)[..., None]).sum((0, 1))
            seen = MitsubaTracer(samples=64).render(Scene((square,), environment=environment), view).rgb.mean((0, 1))
            assert np.allclose(seen, truth, rtol=0.015), (yaw, pitch)

    @pytest.mark.parametrize("metallic", [0.0, 1.0])
    @pytest.mark.parametrize("roughness", [0.0, 0.6, 1.0])
    def test_white_furnace(self, metallic: float, roughness: float) -> None:
        # A white ball in uniform light of 1: metals give all of it back, dielectrics lose a little below the reflection.
        ball = sphere((0, 0, 2), 0.5, Material(metallic=metallic, roughness=roughness))
        layer = MitsubaTracer(samples=64).render(
            Scene((ball,), environment=neutral_environment(1.0)), Camera(40, 30, (45.0, 45.0), (20.0, 15.0))
        )
        shade = layer.rgb[layer.alpha == 1].mean()
        assert shade == pytest.approx(1.0, abs=0.005) if metallic else 0.95 < shade < 1.002

    def test_mirror_shows_the_panorama_the_right_way_round(self) -> None:
        environment = Environment((directions(256, 512) * 0.5 + 0.5).astype(np.float32))
        mirror = laws.facing_square(Material(metallic=1.0, roughness=0.0))
        rgb = MitsubaTracer(samples=16).render(Scene((mirror,), environment=environment), SMALL).rgb
        _, ray = laws.rays(SMALL)
        mirrored = ray * [1, 1, -1] / np.linalg.norm(ray, axis=-1, keepdims=True)
        assert np.abs(rgb - (mirrored * 0.5 + 0.5)).mean() < 0.005

    def test_objects_hide_the_environment_from_each_other(self) -> None:
        # The middle of a floor below a black ball sees the rest of a uniform sky: 1 - sin^2 of the ball's half angle.
        floor = rectangle((-5, 0.5, 8), (10, 0, 0), (0, 0, -10), matte(0.5, 0.5, 0.5))
        ball = sphere((0.0, -0.3, 3.0), 0.4, matte(0.0, 0.0, 0.0))
        view = np.array([[1, 0, 0, 0], [0, 0.8, -0.6, 1.4], [0, 0.6, 0.8, -2.7 + 3.0], [0, 0, 0, 1.0]])
        camera = Camera(16, 12, (800.0, 800.0), (8.0, 6.0), view)
        point_px, _ = camera.project(np.array([0.0, 0.5, 3.0]))
        camera = replace(camera, principal_px=(float(16.0 - point_px[0]), float(12.0 - point_px[1])))
        seen = MitsubaTracer(samples=64).render(Scene((floor, ball), environment=neutral_environment(1.0)), camera).rgb.mean()
        assert seen == pytest.approx(0.5 * (1 - (0.4 / 0.8) ** 2), rel=0.01)


@pytest.mark.usefixtures("backend")
class TestLightPassedOn:
    def test_closed_room_gathers_light_bounce_by_bounce(self) -> None:
        # Walls of radiance E and albedo rho: E (1 + rho + rho^2 + ...) = E / (1 - rho), whatever the shape of the room. Red walls
        # so tint themselves. After 30 bounces 0.8^30 = 0.1 % of the red is missing.
        rho = np.array([0.8, 0.5, 0.2])
        wall = replace(matte(*rho.tolist()), emissive=(0.1, 0.1, 0.1))
        sides = [rectangle((-1, -1, 1), (2, 0, 0), (0, 2, 0), wall)]
        turns = [(0, 1, 0), (0, 2, 0), (0, 3, 0), (1, 0, 0), (3, 0, 0)]
        for pitch, yaw, _ in turns:
            turn = laws.turned_camera(SMALL, yaw * np.pi / 2, pitch * np.pi / 2, (0.0, 0.0, 0.0)).camera_from_world
            sides.append(sides[0].transformed(turn))
        layer = MitsubaTracer(samples=16, most_bounces=30).render(Scene(tuple(sides), environment=laws.DARK), SMALL)
        assert layer.alpha.min() == 1.0
        assert np.allclose(layer.rgb.mean((0, 1)), 0.1 / (1 - rho), rtol=0.01)
        # The same room with one bounce: E (1 + rho); with none: E.
        wall = replace(matte(0.5, 0.5, 0.5), emissive=(1.0, 1.0, 1.0))
        room = sphere((0, 0, 0), 2.0, replace(wall, double_sided=True), rows=32)
        for bounces, radiance in ((0, 1.0), (1, 1.5), (2, 1.75)):
            rgb = MitsubaTracer(samples=16, most_bounces=bounces).render(Scene((room,), environment=laws.DARK), SMALL).rgb
            assert rgb.mean() == pytest.approx(radiance, rel=0.005)

    def test_a_real_floor_lights_what_hangs_above_it(self) -> None:
        # A small plate looks down on a wide floor of albedo 0.6, which shows 0.6 under a sky of 1. The floor itself is not drawn,
        # and lies between camera and plate.
        plate = rectangle((-0.05, -1.0, -0.05), (0.1, 0, 0), (0, 0, 0.1), matte(0.5, 0.5, 0.5))
        floor = rectangle((-50, 0.0, 50), (100, 0, 0), (0, 0, -100), matte(0.6, 0.6, 0.6), catches_shadow=True)
        up = np.array([[1, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 1.0], [0, 0, 0, 1.0]])
        camera = Camera(12, 12, (300.0, 300.0), (6.0, 6.0), up)
        tracer, scene = MitsubaTracer(samples=64), Scene((plate, floor), environment=neutral_environment(1.0))
        assert tracer.render(scene, camera).rgb.mean() == pytest.approx(0.5, rel=0.01)
        assert tracer.render_beside(scene, camera, [floor]).rgb.mean() == pytest.approx(0.5 * 0.6, rel=0.015)


@pytest.mark.usefixtures("backend")
class TestBesideTheRayCaster:
    def test_direct_light_on_a_model(self, shared_data: Path) -> None:
        # Both have one reflection model and one geometry; they differ in how a texture is filtered and in noise within the pixel.
        fox = load_glb(shared_data / "objects" / "Fox.glb").without_lights()
        fox = fox.transformed(world_from_scene_placing(fox, (0.0, 0.45, 2.0), height_m=0.9, turn_rad=0.7))
        scene = fox.with_lights(sun((0.4, 1.0, 0.8), 3.0), Light("point", (2.0, 1.5, 1.0), position_m=(-1.0, -0.6, 0.6)))
        camera = Camera(160, 112, (170.0, 168.0), (80.0, 56.0))
        paths, cast = MitsubaTracer(samples=16, most_bounces=1).render(scene, camera), EmbreeRaycaster().render(scene, camera)
        inside = cast.alpha == 1
        assert inside.sum() > 2000
        assert np.array_equal(paths.alpha, cast.alpha)
        difference = np.abs(paths.rgb - cast.rgb)[inside].mean() / cast.rgb[inside].mean()
        assert difference < 0.05
        assert paths.rgb[inside].mean() == pytest.approx(cast.rgb[inside].mean(), rel=0.01)


@pytest.mark.usefixtures("backend")
class TestSettings:
    def test_seed_decides_about_the_noise_and_many_samples_go_in_parts(self, monkeypatch: pytest.MonkeyPatch) -> None:
        scene = Scene((laws.facing_square(matte(0.5, 0.5, 0.5)),))
        first, again, other = (MitsubaTracer(samples=4, seed=seed).render(scene, SMALL).rgb for seed in (1, 1, 2))
        assert np.array_equal(first, again)
        assert not np.array_equal(first, other)
        whole = MitsubaTracer(samples=16).render(scene, SMALL).rgb
        monkeypatch.setattr("mrbokeh.scene.mitsuba.paths._RAYS_AT_ONCE", 1 << 13)
        parts = MitsubaTracer(samples=16).render(scene, SMALL).rgb
        assert parts.mean() == pytest.approx(whole.mean(), rel=5e-3)
        assert parts.std() == pytest.approx(whole.std(), rel=0.1)

    def test_denoising_gains_where_paths_are_few(self) -> None:
        # A ball under a small lamp; the truth takes 1024 paths.
        pytest.importorskip("pyoidn", reason="the denoiser is not installed: pip install 'mrbokeh[denoise]'")
        lamp = rectangle((-0.5, -1.5, 1.5), (0.5, 0, 0), (0, 0, 0.5), emitter(20.0, 20.0, 20.0))
        scene = Scene((*laws.ball_on_floor(matte(0.5, 0.5, 0.5)).meshes, lamp), environment=neutral_environment(0.1))
        truth = MitsubaTracer(samples=1024).render(scene, SMALL).rgb
        noisy, clean = (MitsubaTracer(samples=4, denoise=denoise).render(scene, SMALL).rgb for denoise in (False, True))
        gain_db = 10 * np.log10(((noisy - truth) ** 2).mean() / ((clean - truth) ** 2).mean())
        assert gain_db > 2.0

    def test_names_and_mistakes(self, monkeypatch: pytest.MonkeyPatch) -> None:
        assert isinstance(scene_renderer("mitsuba"), MitsubaTracer)
        with pytest.raises(InputError, match="at least one sample"):
            MitsubaTracer(samples=0)
        monkeypatch.setitem(sys.modules, "pyoidn", None)
        with pytest.raises(MissingExtraError, match="pyoidn"):
            MitsubaTracer(denoise=True)
        monkeypatch.setitem(sys.modules, "mitsuba", None)
        with pytest.raises(MissingExtraError, match=r"pip install .*\[mitsuba\]"):
            MitsubaTracer()
