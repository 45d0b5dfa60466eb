"""The ray-traced truth against answers known without tracing rays: geometry of the thin lens, areas, and Camera and Lens themselves."""

from dataclasses import replace

import numpy as np
import pytest

from datasets_scripts.tracers.thin_lens import camera_for_lens, trace, trace_pinhole
from datasets_scripts.tracers.traced_scene import DiscLight, Scene, Sphere, emissive_quad, plain_texture
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from tests.support.refusals import refused

SIZE_PX = 64
# A crop of 0.32 mm with 64 px: 90 px of blur per dioptre, so that a small picture shows large blur.
LENS = Lens(35.0, 2.8, 1.0, 0.32)


def camera(lens: Lens, size_px: int = SIZE_PX) -> Camera:
    return camera_for_lens(Camera(size_px, size_px, (1.0, 1.0), (0.5 * size_px, 0.5 * size_px)), lens)


def lamp(x_m: float, y_m: float, z_m: float, radius_m: float, radiance: float = 10.0) -> Scene:
    return Scene(lights=(DiscLight((x_m, y_m, z_m), radius_m, (radiance, radiance, radiance)),))


def wall(z_m: float, texture: np.ndarray, half_m: float = 0.5) -> Scene:
    return Scene((emissive_quad((-half_m, -half_m, z_m), (2 * half_m, 0.0, 0.0), (0.0, 2 * half_m, 0.0), texture),))


def centroid_px(picture: np.ndarray) -> np.ndarray:
    y, x = np.mgrid[: picture.shape[0], : picture.shape[1]] + 0.5
    return np.array([(picture * x).sum(), (picture * y).sum()]) / picture.sum()


@pytest.mark.parametrize("z_m", [pytest.param(0.8, marks=pytest.mark.slow), 1.0, 1.5])
def test_a_lamp_keeps_its_energy_however_blurred(z_m: float) -> None:
    """Sum over the picture = radiance x projected area, pi (r f_px / z)^2: the pupil average moves light but makes none."""
    radius_m = 0.0001
    picture = trace(lamp(0.0, 0.0, z_m, radius_m), camera(LENS), LENS, 512)[..., 0]
    expected = 10.0 * np.pi * (radius_m * LENS.focal_px(SIZE_PX) / z_m) ** 2
    assert picture.sum() == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("z_m", [0.85, 1.25])
def test_a_point_light_is_as_wide_as_the_lens_says(z_m: float) -> None:
    """A tiny lamp through a disc: the diameter of the lit area (4 A / pi) and the width equal |coc_px| within half a pixel."""
    picture = trace(lamp(0.0, 0.0, z_m, 2e-5, 1e4), camera(LENS), LENS, 256)[..., 0]
    coc_px = abs(float(LENS.coc_px(z_m, SIZE_PX)))
    lit = picture / np.median(picture[picture > 0.5 * picture.max()])
    assert np.sqrt(4.0 * lit.sum() / np.pi) == pytest.approx(coc_px, abs=0.5)
    assert lit[SIZE_PX // 2 - 1 : SIZE_PX // 2 + 1].sum(axis=1).mean() == pytest.approx(coc_px, abs=0.5)


@pytest.mark.parametrize("z_m", [0.85, 1.25])
def test_bokeh_is_the_outline_behind_focus_and_its_mirror_image_in_front(z_m: float) -> None:
    """Compare with the exact area coverage of outline x signed coc / 2, which Aperture.rasterize computes without rays."""
    lens = replace(LENS, aperture=Aperture.blades(3, rotation_rad=0.4))
    # A lamp on a pixel's centre, as a PSF has it.
    picture = trace(lamp(0.0, 0.0, z_m, 2e-5, 1e4), camera(lens, 63), lens, 512)[..., 0]
    coc_px = float(lens.coc_px(z_m, 63))
    kernel, mirrored = (lens.aperture.rasterize(sign * coc_px).kernel for sign in (1, -1))
    picture, border = picture / picture.sum(), (63 - len(kernel)) // 2
    assert np.abs(picture - np.pad(kernel, border)).sum() < 0.03
    assert np.abs(picture - np.pad(mirrored, border)).sum() > 0.5


@pytest.mark.slow
def test_many_lens_rays_and_light_sampling_give_the_same_lamp() -> None:
    """A lamp is sampled on itself, a bright emissive quad of the same outline by lens rays: two ways to one integral."""
    side_m, z_m = 0.0006, 1.25
    texture = plain_texture((10.0, 10.0, 10.0))
    quad = Scene((emissive_quad((-side_m / 2, -side_m / 2, z_m), (side_m, 0.0, 0.0), (0.0, side_m, 0.0), texture),))
    by_rays = trace(quad, camera(LENS), LENS, 1024)[..., 0]
    by_light = trace(lamp(0.0, 0.0, z_m, side_m / np.sqrt(np.pi)), camera(LENS), LENS, 256)[..., 0]
    # A square of 3.5 px against a disc of equal area under a blur of 18 px: the same inside, the rim differs by its softness alone.
    inside = by_light > 0.99 * np.median(by_light[by_light > 0.5 * by_light.max()])
    assert inside.sum() > 100
    assert by_rays[inside].mean() == pytest.approx(by_light[inside].mean(), rel=0.01)
    assert by_rays.sum() == pytest.approx(by_light.sum(), rel=0.01)


def edge_scene(z_edge_m: float) -> Scene:
    """A black half plane (x < 0) before a white wall that is in focus."""
    black = emissive_quad((-0.5, -0.5, z_edge_m), (0.5, 0.0, 0.0), (0.0, 1.0, 0.0), plain_texture((0.0, 0.0, 0.0)))
    return Scene((black, *wall(1.0, plain_texture((1.0, 1.0, 1.0))).quads))


@pytest.mark.slow
@pytest.mark.parametrize("shape", ["square", "disc"])
def test_profile_of_a_straight_occluder(shape: str) -> None:
    """Share of the pupil on the free side of the edge: linear for a square, 1/2 + (t sqrt(1-t^2) + asin t) / pi for a disc."""
    square = Aperture((np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]]),), (1.0,))
    lens = replace(LENS, aperture=square if shape == "square" else Aperture.disc())
    picture = trace(edge_scene(0.85), camera(lens), lens, 512)[..., 0]
    radius_px = 0.5 * abs(float(lens.coc_px(0.85, SIZE_PX)))
    x_px = (np.arange(SIZE_PX * 41) + 0.5) / 41 - 0.5 * SIZE_PX
    t = np.clip(x_px / radius_px, -1.0, 1.0)
    free_share = 0.5 + (0.5 * t if shape == "square" else (t * np.sqrt(1.0 - t**2) + np.arcsin(t)) / np.pi)
    expected = free_share.reshape(SIZE_PX, 41).mean(axis=1)
    assert np.abs(picture.mean(axis=0) - expected).max() < 0.004
    # Single pixels: low-discrepancy sampling with 512 rays.
    assert np.abs(picture - expected).max() < 0.04


@pytest.mark.slow
def test_focus_breathing_scales_the_picture_by_the_image_distance() -> None:
    """A lamp off the axis, blurred in front of and behind the focus: its centre moves as d_s = f d_f / (d_f - f), 4.3 % in all."""
    scene = lamp(0.002, 0.001, 0.8, 0.0003)
    near = replace(LENS, f_number=16.0, focus_distance_m=0.6)
    far = near.focused_at(2.0)
    offsets = [centroid_px(trace(scene, camera(lens), lens, 512)[..., 0]) - 0.5 * SIZE_PX for lens in (near, far)]
    ratio = near.image_distance_mm / far.image_distance_mm
    assert ratio == pytest.approx((0.6 / 0.565) / (2.0 / 1.965), rel=1e-12)
    assert offsets[0] == pytest.approx(offsets[1] * ratio, abs=0.03)
    assert offsets[0] == pytest.approx(np.array([0.002, 0.001]) / 0.8 * near.focal_px(SIZE_PX), abs=0.03)


@pytest.mark.slow
def test_what_lies_in_the_focus_plane_is_as_sharp_as_a_pinhole_sees_it() -> None:
    texture = np.random.default_rng(0).random((64, 64, 3)).astype(np.float32)
    scene = wall(1.0, texture, half_m=0.008)
    lens_rgb = trace(scene, camera(LENS), LENS, 512)
    pinhole_rgb, depth_m = trace_pinhole(scene, camera(LENS), 512)
    # Texels of 1.7 px at 1.0 contrast; 512 low-discrepancy points per pixel integrate them to about 1e-3.
    assert np.abs(lens_rgb - pinhole_rgb).max() < 0.01
    np.testing.assert_allclose(depth_m, 1.0, rtol=1e-6)


def test_a_wider_footprint_is_a_box_filter_and_depth_is_along_the_axis_for_a_turned_camera() -> None:
    """Pixel and depth unprojected by Camera lie on the sphere that was traced."""
    ball = Sphere((-0.0338, 0.0051, 1.1996), 0.003, plain_texture((0.5, 0.5, 0.5)))
    angle = 0.02
    pose = np.array([[np.cos(angle), 0, np.sin(angle), 0.01], [0, 1, 0, -0.005], [-np.sin(angle), 0, np.cos(angle), 0.1], [0, 0, 0, 1.0]])
    cam = replace(camera(LENS), camera_from_world=pose)
    depth_m = trace_pinhole(Scene(spheres=(ball,)), cam, 4)[1].astype(np.float64)
    hit = np.isfinite(depth_m)
    points_m = cam.unproject(cam.pixel_centres_px(), np.where(hit, depth_m, 1.0))[hit]
    assert 300 < hit.sum() < hit.size
    np.testing.assert_allclose(np.linalg.norm(points_m - ball.centre_m, axis=1), ball.radius_m, atol=2e-6)
    # An optical low-pass filter of 2 px: each value of a vertical edge's profile is the mean over two pixels' width.
    picture = trace_pinhole(edge_scene(1.0), camera(LENS), 512, footprint_px=2.0)[0][..., 0].mean(axis=0)
    middle = SIZE_PX // 2
    np.testing.assert_allclose(picture[middle - 2 : middle + 2], [0.0, 0.25, 0.75, 1.0], atol=0.005)


def test_a_ring_aperture_leaves_its_middle_dark() -> None:
    disc = Aperture.disc(64).outlines[0]
    lens = replace(LENS, aperture=Aperture((disc, 0.6 * disc), (1.0, -1.0)))
    picture = trace(lamp(0.0, 0.0, 1.25, 2e-5, 1e4), camera(lens), lens, 256)[..., 0]
    middle = picture[SIZE_PX // 2 - 2 : SIZE_PX // 2 + 2, SIZE_PX // 2 - 2 : SIZE_PX // 2 + 2]
    assert middle.max() == 0.0
    expected = 1e4 * np.pi * (2e-5 * lens.focal_px(SIZE_PX) / 1.25) ** 2
    assert picture.sum() == pytest.approx(expected, rel=0.01)


def test_the_seed_decides_every_pixel_and_a_camera_with_another_focal_length_is_refused() -> None:
    texture = np.random.default_rng(0).random((64, 64, 3)).astype(np.float32)
    scene = wall(1.3, texture, half_m=0.008)
    first, again, other = (trace(scene, camera(LENS), LENS, 32, seed) for seed in (5, 5, 6))
    np.testing.assert_array_equal(first, again)
    assert np.abs(first - other).max() > 1e-4
    refused("camera_for_lens", trace, Scene(), camera(LENS), LENS.focused_at(0.5), 16)
