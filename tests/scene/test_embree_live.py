"""What makes the ray caster fast enough for a live picture, each beside its plain twin: the same picture, or within a stated error."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest

from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Environment, Light, Material, Mesh, Scene, Texture, environment_filter, matte, rectangle, sphere, sun
from mrbokeh.scene._lighting_numba import PanoramaLevels
from mrbokeh.scene.embree import embree_raycaster as raycaster_module
from mrbokeh.scene.embree import prepared_scenes as prepared_scenes_module
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.embree.prepared_scenes import PreparedScene, edge_pixels
from mrbokeh.scene.environment_filter import LightingMaps, _moments, filtered, lighting_maps
from mrbokeh.scene.light import directions, solid_angles_sr
from mrbokeh.scene.mesh import rigid_motion
from mrbokeh.scene.packed_scene import packed
from tests.support.refusals import refused

LOOKING_DOWN = np.array([[1, 0, 0, 0], [0, 0.8, -0.6, 0], [0, 0.6, 0.8, 3.0], [0, 0, 0, 1.0]])
CAMERA = Camera(201, 115, (160.0, 158.0), (99.3, 60.7), LOOKING_DOWN)
LIGHTS = (sun((0.5, 1.0, 0.3), 3.0), Light("point", (4.0, 3.0, 2.0), position_m=(-1.0, -2.0, -0.5)))


def panorama(seed: int = 3) -> Environment:
    texels = np.random.default_rng(seed).uniform(0.0, 1.0, (16, 32, 3)).astype(np.float32) ** 4
    return Environment(texels)


def painted(roughness: float = 0.4) -> Material:
    texels = np.random.default_rng(5).uniform(0.2, 0.9, (32, 32, 3)).astype(np.float32)
    return Material(base_color_texture=Texture(texels), normal_texture=Texture(texels), metallic=0.3, roughness=roughness)


def still_life() -> Scene:
    """A textured ball before a veil that lets half of the light through, under a sun, a lamp and a panorama."""
    veil = Material(base_color=(0.2, 0.7, 0.3, 0.5), alpha_mode="BLEND", double_sided=True)
    meshes = (sphere((0.1, 0.0, 0.3), 0.4, painted(), rows=24), rectangle((-0.9, -0.6, 0.9), (0.8, 0.1, 0), (0, 0.9, 0.3), veil))
    return Scene(meshes, LIGHTS, panorama())


def floor() -> Mesh:
    return rectangle((-60, 0.6, 60), (120, 0, 0), (0, 0, -120), Material(), catches_shadow=True)


def moved(turn_rad: float = 0.7, shift_m: tuple[float, float, float] = (0.2, -0.1, 0.15), scale: float = 1.0) -> np.ndarray:
    cosine, sine = np.cos(turn_rad), np.sin(turn_rad)
    motion = np.eye(4)
    motion[:3, :3] = scale * np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    motion[:3, 3] = shift_m
    return motion


@pytest.fixture
def prepared_count(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """How many triangles were prepared, one entry for each time."""
    counts: list[int] = []

    def counting(meshes: list[Mesh], like: PreparedScene | None = None) -> PreparedScene:
        counts.append(sum(len(mesh.triangles) for mesh in meshes))
        return original(meshes, like)

    original = prepared_scenes_module.prepared
    monkeypatch.setattr(prepared_scenes_module, "prepared", counting)
    return counts


class TestEdges:
    def test_the_kernel_marks_what_numpy_marks(self) -> None:
        rng, size = np.random.default_rng(0), (43, 67)
        mesh = np.where(rng.random(size) > 0.04, 0, -1).astype(np.int32) + (rng.random(size) > 0.99)
        alpha = np.where(mesh >= 0, np.where(rng.random(size) > 0.98, 0.5, 1.0), 0.0).astype(np.float32)
        depth_m = np.where(mesh >= 0, 2.0 + 0.001 * rng.standard_normal(size) + (rng.random(size) > 0.98), np.inf)
        towards = rng.standard_normal((*size, 3)) * 0.1 + [0, 0, -1.0]
        normal = np.where((mesh >= 0)[..., None], towards / np.linalg.norm(towards, axis=-1, keepdims=True), 0.0).astype(np.float32)
        lit = np.where(rng.random(size) > 0.98, 0.0, 1.0).astype(np.float32)
        y, x = np.mgrid[0 : size[0], 0 : size[1]]
        rays = np.stack([(x - 15) / 300, (y - 11) / 300, np.ones(size)], axis=-1)
        expected = plain_edge_pixels(mesh, alpha, depth_m, normal, lit, rays)
        assert 0.2 < expected.mean() < 0.9
        assert np.array_equal(edge_pixels(mesh, alpha, depth_m, normal, lit, rays), expected)

    def test_four_rays_are_near_the_truth_and_sixteen_nearer_with_the_same_centre(self) -> None:
        # Four turned samples have an error of coverage of 0.093 RMS over straight edges of all directions, sixteen 0.031.
        camera = Camera(160, 90, (130.0, 127.0), (75.3, 47.7))
        blade = rectangle((-0.9, -0.5, 2.0), (0.45, 0.1, 0), (-0.05, 0.9, 0.2), matte(0.5, 0.5, 0.5))
        scene = Scene((sphere((0.2, 0.0, 2.0), 0.45, matte(0.5, 0.5, 0.5)), blade))
        fine = EmbreeRaycaster().render(scene, camera.resized(160 * 8, 90 * 8)).alpha
        truth = (fine > 0.5).reshape(90, 8, 160, 8).mean((1, 3))
        partly = (truth > 0) & (truth < 1)
        best = EmbreeRaycaster()
        errors = [each.render(scene, camera).alpha - truth for each in (best, best.with_quality(edge_samples=4))]
        assert [np.sqrt((error[partly] ** 2).mean()) < limit for error, limit in zip(errors, (0.04, 0.12), strict=True)] == [True, True]
        assert np.abs(errors[1][partly].mean()) < 0.02
        assert np.abs(errors[1][~partly]).max() <= 0.25
        assert set(np.unique(best.with_quality(edge_samples=4).render(scene, camera).alpha)) <= {0.0, 0.25, 0.5, 0.75, 1.0}
        best = EmbreeRaycaster()
        fine, live = (each.render(still_life(), CAMERA) for each in (best, best.with_quality(4, 2)))
        both = (fine.alpha == 1) & (live.alpha == 1)
        assert both.sum() > 1000
        assert np.array_equal(fine.depth_m[both], live.depth_m[both])

    def test_other_qualities_are_refused(self) -> None:
        for quality, told in (
            ((3, 1), "expected 4 or 16 as edge_samples, got 3: take one"),
            ((64, 1), "4 or 16 as edge_samples, got 64"),
            ((4, 0), "from 1 on as shadow_step_px, got 0"),
        ):
            refused(told, EmbreeRaycaster, edge_samples=quality[0], shadow_step_px=quality[1])


def plain_edge_pixels(
    mesh: np.ndarray, alpha: np.ndarray, depth_m: np.ndarray, normal: np.ndarray, lit: np.ndarray, rays: np.ndarray
) -> np.ndarray:
    """The law of `edge_pixels`, whole pictures at a time: steps of 0.02 in shares and relative depth, turns of 0.5 rad."""
    edges = np.zeros(mesh.shape, np.bool_)
    height, width = mesh.shape
    facing = (normal * rays).sum(-1)
    for down, right in ((0, 1), (1, 0), (1, 1), (1, -1)):
        here = slice(0, height - down), slice(max(-right, 0), width - max(right, 0))
        there = slice(down, height), slice(max(right, 0), width - max(-right, 0))
        differs = (mesh[here] != mesh[there]) | (np.abs(alpha[here] - alpha[there]) > 0.02) | (np.abs(lit[here] - lit[there]) > 0.02)
        if not (down and right):
            with np.errstate(divide="ignore", invalid="ignore"):
                expected_m = depth_m[here] * facing[here] / (normal[here] * rays[there]).sum(-1)
                near_enough = np.abs(depth_m[there] - expected_m) < 0.02 * np.minimum(depth_m[here], depth_m[there])
            alike = near_enough & ((normal[here].astype(np.float64) * normal[there]).sum(-1) > np.cos(0.5))
            differs |= (mesh[here] >= 0) & (mesh[there] >= 0) & ~alike
        edges[here] |= differs
        edges[there] |= differs
    return edges


class TestWindow:
    @pytest.mark.parametrize("ahead_m", [3.0, 0.35, 0.0, -0.45, -3.0])
    @pytest.mark.parametrize("aside_m", [0.0, 1.1])
    def test_what_lies_outside_is_clear_in_the_whole_picture_too(self, ahead_m: float, aside_m: float) -> None:
        pose = np.eye(4)
        pose[:3, 3] = aside_m, 0.0, ahead_m - 0.3
        camera, backend = Camera(96, 64, (80.0, 80.0), (48.0, 32.0), pose), EmbreeRaycaster()
        scene = still_life()
        placed = backend._kept.placed(scene)
        assert placed is not None
        layer, whole = backend.render(scene, camera), backend._rendered(placed, scene, camera)
        assert np.array_equal(layer.alpha, whole.alpha)
        assert np.allclose(layer.rgb, whole.rgb, rtol=1e-5, atol=1e-6)
        assert np.array_equal(np.isinf(layer.depth_m), np.isinf(whole.depth_m))


class TestMoving:
    def test_a_moved_scene_is_not_prepared_again_and_looks_as_if_it_were(self, prepared_count: list[int]) -> None:
        # float32 rounds the triangles differently in the two axes: 2e-8 of 1 m, which only an edge can make visible.
        backend, scene = EmbreeRaycaster(), still_life()
        backend.render(scene, CAMERA)
        there = replace(scene.transformed(moved()), lights=LIGHTS)
        fast, fast_mask = backend.render(there, CAMERA), backend.render_shadow_mask(there, CAMERA, floor())
        assert prepared_count == [len(scene.meshes[0].triangles) + 2, 2]
        plain = EmbreeRaycaster()
        slow, slow_mask = plain.render(there, CAMERA), plain.render_shadow_mask(there, CAMERA, floor())
        assert (slow.alpha > 0).sum() > 1500
        assert (np.abs(fast.alpha - slow.alpha) > 1e-6).sum() <= 5
        alike = (np.abs(fast.alpha - slow.alpha) < 1e-6) & (slow.alpha > 0)
        assert np.abs(fast.depth_m[alike] - slow.depth_m[alike]).max() < 1e-5
        assert np.quantile(np.abs(fast.rgb - slow.rgb)[alike], 0.999) < 1e-3
        assert np.mean(np.abs(fast_mask - slow_mask) > 1e-3) < 1e-3
        assert (slow_mask < 0.9).sum() > 300

    @pytest.mark.parametrize(
        "change",
        [
            lambda scene: scene.transformed(moved(scale=1.2)),
            lambda scene: replace(scene, meshes=(scene.meshes[0].transformed(moved()), scene.meshes[1])),
            lambda scene: replace(scene, meshes=(replace(scene.meshes[0], material=matte(0.9, 0.1, 0.1)), scene.meshes[1])),
            lambda scene: scene.transformed(np.diag([-1.0, 1.0, 1.0, 1.0])),
            lambda scene: replace(scene, meshes=(replace(scene.meshes[0], normals=-scene.meshes[0].normals), scene.meshes[1])),
            lambda scene: replace(scene, meshes=scene.meshes[:1]),
        ],
        ids=["resized", "one of two", "material", "mirrored", "normals", "one gone"],
    )
    def test_any_other_change_is_prepared_anew(self, change: Callable[[Scene], Scene], prepared_count: list[int]) -> None:
        backend, scene = EmbreeRaycaster(), still_life()
        backend.render(scene, CAMERA)
        other = replace(change(scene), lights=LIGHTS)
        assert rigid_motion(scene.meshes, other.meshes) is None
        result = backend.render(other, CAMERA)
        assert len(prepared_count) == 2
        truth = EmbreeRaycaster().render(other, CAMERA)
        assert np.array_equal(result.rgb, truth.rgb)
        assert np.array_equal(result.alpha, truth.alpha)

    def test_the_motion_is_found_exactly_and_qualities_share_what_was_prepared(self, prepared_count: list[int]) -> None:
        scene, motion = still_life(), moved(2.0, (5000.0, -300.0, 8000.0))
        found = rigid_motion(scene.meshes, scene.transformed(motion).meshes)
        assert found is not None
        assert np.abs(found - motion).max() < 1e-7
        flat = scene.meshes[1:]
        found = rigid_motion(flat, tuple(mesh.transformed(motion) for mesh in flat))
        assert found is not None
        assert np.abs(found[:3, :3] - motion[:3, :3]).max() < 1e-9
        best, scene = EmbreeRaycaster(), still_life()
        best.with_quality(4, 2).render(scene, CAMERA)
        best.render(scene, CAMERA)
        assert len(prepared_count) == 1


class TestShadowMask:
    @pytest.mark.parametrize("lights", [LIGHTS[:1], LIGHTS[1:], LIGHTS])
    def test_looking_only_where_shadows_can_fall_changes_nothing(self, lights: tuple[Light, ...]) -> None:
        scene, backend, catcher = replace(still_life(), lights=lights), EmbreeRaycaster(), floor()
        fast = backend.render_shadow_mask(scene, CAMERA, catcher)
        backend._kept._grounds[catcher] = replace(backend._kept.ground(catcher), is_flat=False)  # then every pixel is looked at
        assert np.array_equal(fast, backend.render_shadow_mask(scene, CAMERA, catcher))
        assert (fast < 0.9).sum() > 300

    def test_every_second_pixel_is_near_every_pixel(self) -> None:
        # Only the border is wrong, by what interpolating over two pixels does to a hard step; the darkness as a whole is kept.
        scene, backend = still_life(), EmbreeRaycaster()
        whole, coarse = (each.render_shadow_mask(scene, CAMERA, floor()) for each in (backend, backend.with_quality(16, 2)))
        assert coarse.shape == whole.shape == (115, 201)
        assert (1 - coarse).sum() == pytest.approx((1 - whole).sum(), rel=0.01)
        assert np.abs(coarse - whole).mean() < 0.01
        far = ~near_a_step(whole, 3)
        assert far.mean() > 0.5
        # Elsewhere they differ only at slivers of shadow so thin that the centres of all their pixels miss them.
        assert np.mean(np.abs(coarse - whole)[far] > 0.02) < 1e-3
        assert np.abs(coarse - whole)[far].max() < 1 / 16


def near_a_step(mask: np.ndarray, pixels: int) -> np.ndarray:
    padded = np.pad(mask, pixels, mode="edge")
    around = [padded[y : y + mask.shape[0], x : x + mask.shape[1]] for y in range(2 * pixels + 1) for x in range(2 * pixels + 1)]
    return np.ptp(np.stack(around), axis=0) > 0.01


def level_of(levels: PanoramaLevels, number: int) -> np.ndarray:
    start, (height, width) = levels.start[number], levels.size[number]
    return levels.radiance[start : start + height * width].reshape(height, width, 3)


class TestLightingMaps:
    def same(self, one: LightingMaps, other: LightingMaps) -> None:
        assert np.allclose(one.irradiance.radiance, other.irradiance.radiance, rtol=1e-4, atol=1e-7)
        assert np.allclose(one.reflections.radiance, other.reflections.radiance, rtol=1e-4, atol=1e-7)
        assert np.allclose(one.peaks, other.peaks, rtol=1e-4, atol=1e-9)

    def test_another_exposure_and_turn_is_scaled_and_turned_but_another_panorama_filtered(self) -> None:
        first = panorama(11)
        lighting_maps(first)
        other = first.turned(0.4).brighter(2.5)
        maps = lighting_maps(other)
        self.same(maps, filtered(other.radiance))
        assert np.array_equal(maps.environment_from_world, other.world_from_environment.T)
        first = panorama(12)
        lighting_maps(first)
        texels = first.radiance.copy()
        texels[5, 7] *= 3.0
        self.same(lighting_maps(Environment(texels)), filtered(texels))

    def test_even_light_is_what_filtering_makes_of_light_that_is_nearly_even(self) -> None:
        texels = np.full((40, 80, 3), 1.5, np.float32)
        even, texels[3, 4] = filtered(texels.copy()), 1.5001
        seen = filtered(texels)
        assert len(even.peaks) == 0 and len(seen.peaks) > 0
        assert np.unique(even.reflections.radiance) == np.unique(even.irradiance.radiance) == 1.5
        # Each level is sampled by lobes that the horizon cuts, which loses up to 0.4 %.
        np.testing.assert_allclose(seen.reflections.radiance, 1.5, rtol=0.005)

    def test_few_pixels_are_filtered_as_many_are(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """The twin draws at most 256 samples a lobe, of which one is a percent or two off; narrow lobes see less than a pixel."""
        texels = np.random.default_rng(6).random((6, 12, 3)).astype(np.float32) + np.float32(0.5)
        smooth = cv2.resize(texels, (64, 32), interpolation=cv2.INTER_LINEAR)
        few = filtered(smooth)
        monkeypatch.setattr(environment_filter, "_SMALL_WIDTH_PX", 0)
        many = filtered(smooth)
        peaks = np.maximum(np.einsum("hwk,pck->hwpc", directions(32, 64), many.peaks), 0.0).sum(axis=2).reshape(-1, 3)
        np.testing.assert_allclose(few.irradiance.radiance, many.irradiance.radiance + peaks, rtol=2e-3)
        for level in (3, 4, 6, 8):
            one, other = (cv2.resize(level_of(each.reflections, level), (64, 32), interpolation=cv2.INTER_AREA) for each in (few, many))
            assert np.sqrt(((one - other) ** 2).mean()) < 0.02 * other.mean()

    def test_moments_are_sums_over_blocks(self) -> None:
        # 64x128 pixels are one pixel per block: radiance * solid angle * direction.
        radiance = np.random.default_rng(0).uniform(0, 1, (64, 128, 3)).astype(np.float32)
        light = radiance * solid_angles_sr(64, 128)[..., None]
        expected = light.reshape(-1, 3, 1) * directions(64, 128).reshape(-1, 1, 3)
        assert np.abs(_moments(radiance) - expected).max() < 1e-6 * np.abs(expected).max()


class TestTextures:
    def test_one_picture_in_two_slots_is_stored_once_and_gives_the_same_light(self) -> None:
        texels = np.random.default_rng(2).uniform(0, 1, (8, 8, 3)).astype(np.float32)
        glow, plain = Texture(texels, ("clamp", "clamp")), Texture(texels)
        rough = Material(metallic_roughness_texture=plain, occlusion_texture=Texture(texels), emissive_texture=glow)
        ball = sphere((0, 0, 2), 0.5, rough, rows=6)
        _, materials, kept = packed([ball], np.zeros(3))
        assert len(kept.packed.first_level) == 3
        assert materials.textures[0].tolist() == [-1, 0, 1, -1, 0]
        again = packed([ball.transformed(moved())], np.zeros(3), kept)[2]
        assert again is kept
        texels = np.random.default_rng(2).uniform(0.2, 1, (8, 8, 3)).astype(np.float32)
        one = Material(metallic_roughness_texture=Texture(texels), occlusion_texture=Texture(texels), occlusion_strength=0.7)
        two = replace(one, occlusion_texture=Texture(texels.copy()))
        scenes, camera = [Scene((sphere((0, 0, 3), 0.5, each),), LIGHTS, panorama()) for each in (one, two)], CAMERA.resized(64, 48)
        pictures = [EmbreeRaycaster().render(each, camera) for each in scenes]
        assert pictures[0].alpha.max() == 1
        assert np.array_equal(pictures[0].rgb, pictures[1].rgb)


def test_few_rays_at_once_give_the_same_picture(monkeypatch: pytest.MonkeyPatch) -> None:
    scene = still_life()
    expected = EmbreeRaycaster(threads=1).render(scene, CAMERA)
    monkeypatch.setattr(raycaster_module, "_RAYS_AT_ONCE", 777)
    assert np.array_equal(EmbreeRaycaster(threads=2).render(scene, CAMERA).rgb, expected.rgb)
