"""WgpuRasterizer beside the ray caster, its slow twin: same shading, same shadows; what it keeps on the device; its tiles.

The laws of every backend are asked in test_scene_backends.py.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Environment, Light, Material, Scene, Texture, matte, rectangle, sphere, sun
from mrbokeh.scene.choose import described_device, has_graphics_card, scene_renderer
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.light import directions
from mrbokeh.system.errors import InputError
from tests.support.refusals import refused

pytest.importorskip("wgpu", reason="wgpu is not installed: pip install 'mrbokeh[viewfinder]'")

from mrbokeh.scene.wgpu import geometry as wgpu_textures
from mrbokeh.scene.wgpu.device import Gpu, gpu
from mrbokeh.scene.wgpu.visibility import light_views, sample_places, tiles
from mrbokeh.scene.wgpu.wgpu_rasterizer import WgpuRasterizer

FOX = Path(__file__).resolve().parents[3] / "shared/data/objects/Fox.glb"
CAMERA = Camera(200, 120, (170.0, 165.0), (96.3, 63.7))
SUN = sun((0.5, 1.0, 0.3), 3.0)


@pytest.fixture(scope="module")
def rasterizer() -> WgpuRasterizer:
    try:
        return WgpuRasterizer()
    except InputError as no_device:
        pytest.skip(str(no_device))


@pytest.fixture(scope="module")
def raycaster() -> EmbreeRaycaster:
    return EmbreeRaycaster(threads=1)


def sky() -> Environment:
    towards = directions(64, 128)
    lamp = 20.0 * np.exp(60 * (towards @ np.array([0.6, -0.64, -0.48]) - 1))
    return Environment((np.stack([0.4 - 0.3 * towards[..., 1]] * 3, axis=-1) + lamp[..., None] * [1.0, 0.6, 0.3]).astype(np.float32))


def noise(seed: int, low: float, high: float, channels: int = 3) -> Texture:
    """Smooth noise of 4x4 waves in 64x64 texels."""
    coarse = np.random.default_rng(seed).uniform(low, high, (4, 4, channels)).astype(np.float32)
    return Texture(np.repeat(np.repeat(coarse, 16, axis=0), 16, axis=1), ("repeat", "mirror"))


def everything() -> Scene:
    """Every kind of texture and light at once: a textured ball on a floor, a metal ball, a panorama, sun, lamp and spot."""
    normals = replace(noise(4, 0.35, 0.65), texels=(noise(4, 0.35, 0.65).texels * [1, 1, 0] + [0, 0, 0.95]).astype(np.float32))
    painted = Material(
        base_color_texture=noise(1, 0.1, 0.9),
        metallic_roughness_texture=noise(2, 0.2, 1.0),
        emissive=(0.2, 0.1, 0.0),
        emissive_texture=noise(3, 0.0, 1.0),
        normal_texture=normals,
        occlusion_texture=noise(5, 0.3, 1.0),
    )
    metal = Material(base_color=(0.9, 0.7, 0.4, 1.0), metallic=1.0, roughness=0.3)
    balls = (sphere((-0.5, 0.1, 2.5), 0.4, painted, rows=48), sphere((0.45, 0.2, 2.2), 0.3, metal, rows=48))
    floor = rectangle((-4, 0.5, 6), (8, 0, 0), (0, 0, -6), matte(0.5, 0.5, 0.5))
    lamp = Light("point", (1.5, 1.0, 0.5), position_m=(0.0, -0.8, 2.0))
    spot = Light("spot", (2.0, 4.0, 6.0), (1.5, -1.5, 2.5), (-0.6, 0.8, 0.0), inner_cone_rad=0.2, outer_cone_rad=0.5)
    return Scene((*balls, floor), (SUN, lamp, spot), sky())


def assert_alike(fast: Layer, slow: Layer, largest_mean: float = 2e-3) -> None:
    """Both have 16 samples per edge pixel at other places: there colours may differ by a few sixteenths, elsewhere they agree."""
    interior = (fast.alpha == 1) & (slow.alpha == 1)
    difference = np.abs(fast.rgb - slow.rgb).max(-1)
    assert np.abs(fast.alpha - slow.alpha).max() < 0.26
    assert np.percentile(difference[interior], 95) < 2e-3 * max(1.0, slow.rgb.max())
    assert difference.mean() < largest_mean * max(1.0, slow.rgb.max())
    both = np.isfinite(fast.depth_m) & np.isfinite(slow.depth_m) & interior
    assert np.percentile(np.abs(fast.depth_m[both] - slow.depth_m[both]), 99) < 1e-5


class TestTwin:
    def test_all_textures_and_lights_look_as_in_the_ray_caster(self, rasterizer: WgpuRasterizer, raycaster: EmbreeRaycaster) -> None:
        assert_alike(rasterizer.render(everything(), CAMERA), raycaster.render(everything(), CAMERA))

    def test_blended_layers_and_their_shadows(self, rasterizer: WgpuRasterizer, raycaster: EmbreeRaycaster) -> None:
        glass = Material(base_color=(0.8, 0.9, 1.0, 0.4), roughness=0.2, metallic=0.0, alpha_mode="BLEND")
        leaf = Material(base_color_texture=noise(7, 0.0, 1.0, channels=4), alpha_mode="MASK", double_sided=True)
        bubble, wall = sphere((-0.3, 0.0, 2.0), 0.4, glass, rows=32), rectangle((-2, -2, 3), (4, 0, 0), (0, 4, 0), matte(0.5, 0.5, 0.5))
        pane = rectangle((0.1, -0.4, 1.8), (0.6, 0, 0.1), (0, 0.8, 0), leaf)
        scene = Scene((bubble, pane, wall), (sun((0.3, 0.2, 1.0), 3.0),))
        assert_alike(rasterizer.render(scene, CAMERA), raycaster.render(scene, CAMERA), largest_mean=4e-3)

    def test_shadow_mask_under_glass_and_leaves(self, rasterizer: WgpuRasterizer, raycaster: EmbreeRaycaster) -> None:
        glass = Material(base_color=(1, 1, 1, 0.4), alpha_mode="BLEND")
        leaf = Material(base_color_texture=noise(7, 0.0, 1.0, channels=4), alpha_mode="MASK")
        panes = [rectangle((x, -0.2, 3.0), (0.7, 0, 0), (0, 0, -1.0), kind) for x, kind in ((-0.8, glass), (0.1, leaf))]
        floor = rectangle((-4, 0.5, 6), (8, 0, 0), (0, 0, -6), Material(), catches_shadow=True)
        scene = Scene(tuple(panes), (sun((0.1, 1.0, 0.0), 3.0),))
        fast, slow = (backend.render_shadow_mask(scene, CAMERA, floor) for backend in (rasterizer, raycaster))
        assert (np.abs(slow - 0.6) < 0.01).sum() > 500  # what the glass lets through
        assert np.abs(fast - slow).mean() < 4e-3
        assert (np.abs(fast - slow) > 0.26).mean() < 2e-3

    @pytest.mark.skipif(not FOX.exists(), reason="needs ../shared/data/objects/Fox.glb")
    def test_shadows_follow_the_skinned_pose(self, rasterizer: WgpuRasterizer, raycaster: EmbreeRaycaster) -> None:
        from mrbokeh.scene import world_from_scene_placing
        from mrbokeh.scene.gltf.gltf_loader import GltfAsset

        fox = GltfAsset(FOX)
        floor = rectangle((-4, 0.5, 6), (8, 0, 0), (0, 0, -6), Material(), catches_shadow=True)
        masks = []
        for time_s in (0.0, 0.35):
            scene = fox.scene_at(time_s, animation=2)
            scene = scene.transformed(world_from_scene_placing(scene, stands_at_m=(0.0, 0.5, 2.5), height_m=0.6)).with_lights(SUN)
            masks.append([backend.render_shadow_mask(scene, CAMERA, floor) for backend in (rasterizer, raycaster)])
        for fast, slow in masks:
            shadow = slow < 0.5
            assert shadow.sum() > 200
            assert (shadow & (fast < 0.5)).sum() / (shadow | (fast < 0.5)).sum() > 0.97
        assert (np.abs(masks[0][0] - masks[1][0]) > 0.5).sum() > 50


class TestWhatStaysOnTheDevice:
    def test_a_new_camera_uploads_next_to_nothing(self, rasterizer: WgpuRasterizer, monkeypatch: pytest.MonkeyPatch) -> None:
        scene, uploaded = everything(), []
        rasterizer.render(scene, CAMERA)
        write = Gpu.write
        monkeypatch.setattr(Gpu, "write", lambda self, buffer, values: uploaded.append(values.nbytes) or write(self, buffer, values))
        rasterizer.render(scene, replace(CAMERA, principal_px=(90.0, 60.0)))
        # Five views of 144 bytes and a frame of 384.
        assert sum(uploaded) == 5 * 144 + 384

    def test_a_new_pose_keeps_the_textures(self, rasterizer: WgpuRasterizer, monkeypatch: pytest.MonkeyPatch) -> None:
        scene = everything()
        rasterizer.render(scene, CAMERA)
        monkeypatch.setattr(wgpu_textures, "_uploaded", lambda *_: pytest.fail("texels were uploaded again"))
        moved = scene.transformed(np.array([[1, 0, 0, 0.1], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
        assert not np.array_equal(rasterizer.render(moved, CAMERA).alpha, rasterizer.render(scene, CAMERA).alpha)

    def test_too_many_texels_lose_fine_levels_of_the_largest_first(self, monkeypatch: pytest.MonkeyPatch) -> None:
        large, small = Texture(np.zeros((64, 64, 3), np.float32)), Texture(np.zeros((16, 16, 3), np.float32))
        assert wgpu_textures._skipped_levels([large, small]) == [0, 0]
        # 64 * 64 * 4/3 = 5461 and 341 texels; without its finest level the large one has 1365.
        monkeypatch.setattr(wgpu_textures, "_MOST_TEXELS", 2000)
        assert wgpu_textures._skipped_levels([large, small]) == [1, 0]


class TestPictures:
    def test_tiles_and_crops_show_the_same_pixels(self, rasterizer: WgpuRasterizer) -> None:
        # 2200 px are more than a tile is wide; the right half of the picture by itself has to be the same.
        ball = sphere((0.0, 0.0, 2.0), 0.5, matte(0.5, 0.5, 0.5), rows=24)
        wide = Camera(2200, 40, (1800.0, 1800.0), (1100.0, 20.0))
        whole = rasterizer.render(Scene((ball,)), wide)
        part = rasterizer.render(Scene((ball,)), replace(wide, width_px=1100, principal_px=(0.0, 20.0)))
        assert (whole.alpha > 0).any(0).sum() > 850
        assert np.allclose(whole.rgb[:, 1100:], part.rgb, atol=0.07)
        assert np.abs(whole.alpha[:, 1100:] - part.alpha).max() <= 1 / 16
        assert np.nanmean(np.abs(whole.rgb[:, 1100:] - part.rgb)) < 1e-4

    def test_tiles_cover_a_rectangle_once(self) -> None:
        covered = np.zeros((50, 70), int)
        for x, y, width, height in tiles((3, 5), (70, 50), (32, 16)):
            covered[y : y + height, x : x + width] += 1
        assert (covered[5:, 3:] == 1).all()
        assert covered.sum() == 45 * 67

    def test_sixteen_samples_lie_in_sixteen_rows_and_columns(self) -> None:
        places, further = sample_places()
        assert sorted((places[:, 0] * 16).astype(int)) == sorted((places[:, 1] * 16).astype(int)) == list(range(16))
        assert set(further.ravel()) <= {0.0, 1.0}

    def test_an_object_behind_the_camera_or_beside_it(self, rasterizer: WgpuRasterizer) -> None:
        for centre in ((0.0, 0.0, -2.0), (30.0, 0.0, 2.0)):
            layer = rasterizer.render(Scene((sphere(centre, 0.5, matte(0.5, 0.5, 0.5)),)), CAMERA)
            assert layer.alpha.max() == 0
            assert np.isinf(layer.depth_m).all()

    def test_a_point_light_takes_one_map_from_outside_and_six_from_within(self) -> None:
        box = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-1.0, 1.0)])
        assert len(light_views(Light("point", (1, 1, 1), (0.0, -5.0, 0.0)), box, 64)) == 1
        assert len(light_views(Light("point", (1, 1, 1), (0.2, 0.1, 0.0)), box, 64)) == 6


class TestChoice:
    @pytest.mark.usefixtures("rasterizer")
    def test_by_name(self) -> None:
        assert isinstance(scene_renderer("embree"), EmbreeRaycaster)
        assert isinstance(scene_renderer("wgpu"), WgpuRasterizer)
        assert isinstance(scene_renderer(), WgpuRasterizer if has_graphics_card() else EmbreeRaycaster)
        assert gpu().name in described_device()
        refused("auto, wgpu or embree", scene_renderer, "opengl")

    @pytest.mark.usefixtures("rasterizer")
    def test_impossible_settings(self) -> None:
        refused("shadow maps", WgpuRasterizer, shadow_map_px=4)
