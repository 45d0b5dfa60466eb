"""A small traced focal stack with its truth, as the merging would leave it: what the report and the data set are tested on."""

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from datasets_scripts.scenes.desk import desk_camera
from datasets_scripts.scenes.textures import bricks, checks, mottled, page_of_text
from datasets_scripts.tracers.thin_lens import trace, trace_pinhole
from datasets_scripts.tracers.traced_scene import Quad, Scene, emissive_quad
from mrbokeh.images.camera_rgb import write_camera_rgb
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack, write_merged

WIDTH_PX, HEIGHT_PX = 160, 107
SLICES = 6
FOCUS_M = tuple(float(each) for each in 1.0 / np.linspace(1.0 / 0.65, 1.0 / 2.05, SLICES))
LENS = Lens(35.0, 1.0, FOCUS_M[0], 23.5, Aperture.disc())
SAMPLES = 32


@dataclass(frozen=True)
class TracedStack:
    """Registered slices (N, H, W, 3), what a pinhole sees, and its depth."""

    slices: np.ndarray
    all_in_focus: np.ndarray
    depth_m: np.ndarray
    camera: Camera
    scales: tuple[float, ...]


def still_life(card_x_m: float = 0.1) -> Scene:
    """Printed things at 0.75 m to 1.95 m, shining by themselves: no light to bake. card_x_m: where the card at 1 m stands."""
    rng = np.random.default_rng(5)
    wall = mottled(256, rng, (0.15, 0.2, 0.25), (0.6, 0.6, 0.5), contrast=0.5)
    table = bricks(256, rng, rows=12, columns=8)
    page = page_of_text(192, 256, rng, (0.06, 0.06, 0.08), (0.8, 0.79, 0.74), cell=8)
    check = checks(192, rng, (0.06, 0.12, 0.28), (0.68, 0.66, 0.58), count=8)
    return Scene(
        (
            emissive_quad((-1.5, -1.2, 1.95), (3.0, 0.0, 0.0), (0.0, 1.8, 0.0), wall, (3.0, 2.0)),
            emissive_quad((-1.5, 0.24, 1.95), (3.0, 0.0, 0.0), (0.0, 0.0, -1.7), table, (4.0, 2.0)),
            _card(-0.2, 0.75, 0.16, page),
            _card(card_x_m, 1.0, 0.18, check),
            _card(0.32, 1.4, 0.26, page),
        )
    )


def _card(x_m: float, z_m: float, size_m: float, texture: np.ndarray) -> Quad:
    return emissive_quad((x_m, 0.24 - size_m, z_m), (size_m, 0.0, 0.0), (0.0, size_m, 0.0), texture)


@cache
def traced(view: int = 0, card_x_m: float = 0.1, from_slice: int = 0) -> TracedStack:
    """All slices are seen with the focal length of the first, as registration would make them; blur is larger by the same factor.

    from_slice: those before it are left out.
    """
    scene = still_life(card_x_m)
    camera = desk_camera(view, WIDTH_PX, HEIGHT_PX, LENS)
    lenses = [LENS.focused_at(each) for each in FOCUS_M]
    enlarged = [replace(lens, sensor_width_mm=23.5 * lens.image_distance_mm / lenses[0].image_distance_mm) for lens in lenses]
    slices = [trace(scene, camera, enlarged[index], SAMPLES, 100 * view + index) for index in range(from_slice, SLICES)]
    rgb, depth_m = trace_pinhole(scene, camera, SAMPLES, 1)
    scales = tuple(lenses[0].image_distance_mm / lens.image_distance_mm for lens in lenses)
    return TracedStack(np.stack(slices).astype(np.float32), rgb.astype(np.float32), depth_m.astype(np.float32), camera, scales)


def write_stack(folder: Path, truth: TracedStack, *, noise: float = 0.005, seed: int = 1) -> FocalStack:
    """A merged stack whose all-in-focus picture and depth are the truth; noise: of a slice's radiance 1, growing as photons do.

    It has the slices of the truth, at the first focus distances.
    """
    rng = np.random.default_rng(seed)
    slices = []
    for index, rgb in enumerate(truth.slices):
        noisy = rgb + noise * np.sqrt(np.maximum(rgb, 0.0)) * rng.standard_normal(rgb.shape)
        path = f"registered/{index:02d}.exr"
        write_camera_rgb(folder / path, noisy.astype(np.float32), None)
        slices.append(Slice(path, FOCUS_M[index], truth.scales[index]))
    height, width = truth.depth_m.shape
    dioptres = 1.0 / truth.depth_m
    index = np.interp(-dioptres, [-1.0 / each for each in FOCUS_M[: len(slices)]], np.arange(len(slices))).astype(np.float32)
    write_merged(folder, truth.all_in_focus, index, np.ones((height, width), np.float32), truth.depth_m)
    stack = FocalStack(folder, tuple(slices), LENS, truth.camera, 0, registered=True, merged=True)
    write_focal_stack(stack)
    return stack
