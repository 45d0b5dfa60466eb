"""Small traced scenes for tests of dense depth: pictures, cameras and depths are exact."""

from dataclasses import dataclass
from functools import cache

import numpy as np

from datasets_scripts.scenes.textures import mottled
from datasets_scripts.tracers.thin_lens import trace_pinhole
from datasets_scripts.tracers.traced_scene import Quad, Scene, emissive_quad, plain_texture
from mrbokeh.depth.views.sweep_view import SweepView, structure_of
from mrbokeh.optics.camera import Camera

WIDTH_PX, HEIGHT_PX, FOCAL_PX = 160, 112, 170.0
SAMPLES = 8
PLACES_M = ((0.0, 0.0, 0.0), (0.06, 0.0, 0.0), (-0.06, 0.0, 0.005), (0.0, 0.05, 0.0), (0.0, -0.05, -0.005))


@dataclass(frozen=True, eq=False)
class TracedViews:
    """views[0] is the reference; rgb and depth_m belong to the views."""

    views: list[SweepView]
    rgb: list[np.ndarray]
    depth_m: list[np.ndarray]

    @property
    def dioptre(self) -> np.ndarray:
        return (1.0 / self.depth_m[0]).astype(np.float32)


@cache
def wall(z_m: float, seed: int = 0, tilt: float = 0.0) -> Quad:
    """Textured, wider than the view; tilt: metres farther off per metre to the right."""
    texture = mottled(512, np.random.default_rng(seed), (0.1, 0.1, 0.1), (0.8, 0.75, 0.7), slope=0.3, contrast=0.5)
    return emissive_quad((-2.0, -2.0, z_m - 2.0 * tilt), (4.0, 0.0, 4.0 * tilt), (0.0, 4.0, 0.0), texture, (8.0, 8.0))


@cache
def card(z_m: float, left_m: float, right_m: float, seed: int = 1) -> Quad:
    """Textured, over the whole height of the view."""
    texture = mottled(512, np.random.default_rng(seed), (0.5, 0.2, 0.1), (0.9, 0.5, 0.3), slope=0.3, contrast=0.5)
    return emissive_quad((left_m, -1.0, z_m), (right_m - left_m, 0.0, 0.0), (0.0, 2.0, 0.0), texture, (2.0, 10.0))


@cache
def grey_card(z_m: float, left_m: float, right_m: float) -> Quad:
    return emissive_quad((left_m, -0.08, z_m), (right_m - left_m, 0.0, 0.0), (0.0, 0.16, 0.0), plain_texture((0.2, 0.25, 0.5)))


@cache
def _seen(quads: tuple[Quad, ...], place_m: tuple[float, float, float], number: int) -> tuple[Camera, np.ndarray, np.ndarray]:
    pose = np.eye(4)
    pose[:3, 3] = -np.asarray(place_m)
    camera = Camera(WIDTH_PX, HEIGHT_PX, (FOCAL_PX, FOCAL_PX), (0.5 * WIDTH_PX, 0.5 * HEIGHT_PX), pose)
    rgb, depth_m = trace_pinhole(Scene(quads), camera, SAMPLES, number, 1.2)
    depth_m.flags.writeable = False
    return camera, rgb, depth_m


def traced(quads: tuple[Quad, ...], places_m: tuple[tuple[float, float, float], ...] = PLACES_M, noise: float = 0.0) -> TracedViews:
    """Cameras that all look along z from the places; noise: standard deviation at white, falling with the root of light."""
    rng = np.random.default_rng(3)
    views, pictures, depths = [], [], []
    for number, place in enumerate(places_m):
        camera, rgb, depth_m = _seen(quads, place, number)
        rgb = rgb + (noise * np.sqrt(rgb) * rng.normal(size=rgb.shape)).astype(np.float32)
        views.append(SweepView(structure_of(rgb), camera))
        pictures.append(rgb)
        depths.append(depth_m)
    return TracedViews(views, pictures, depths)
