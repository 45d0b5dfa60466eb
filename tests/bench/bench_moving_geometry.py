"""How long distortion and motion of virtual layers take at 1080p: `python -m tests.bench.bench_moving_geometry`.

A textured object in a box of the frame, warped into a strongly distorted plate; yardstick in the same run: OpenCV's remap
(bilinear, one tap set per pixel, no area, no depth, no motion) of the same box with the same positions. Then the demo's alien
in even motion: the sharp picture, the same with motion channels, with a rolling shutter, and the average of 16 moments.
"""

import time
from collections.abc import Callable
from pathlib import Path
from statistics import median

import cv2
import numpy as np

from mrbokeh.distortion import LensDistortion, distorted, overscan_camera
from mrbokeh.distortion.warping import _reached_box, sampled_positions_px
from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import with_motion
from mrbokeh.layering.pixel_box import lit_box
from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Scene, sun, world_from_scene_placing
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.gltf.gltf_loader import load_glb
from mrbokeh.scene.moving_layers import FilmedScene, ShutterTiming, accumulated, moving_layer
from tests.bench.machine import machine_line, memory_line

PLATE = Camera(1920, 1080, (1600.0, 1590.0), (950.3, 545.1))
DISTORTION = LensDistortion.of("opencv", k1=-0.25, k2=0.08, p1=1e-3, p2=-5e-4)
BOXES = {"480x540": (270, 720, 540, 480), "960x1000": (40, 480, 1000, 960), "all of it": (0, 0, 4000, 4000)}
ALIEN = Path(__file__).resolve().parents[2] / "mrbokeh" / "demo_data" / "objects" / "alien.glb"


def _milliseconds(run: Callable[[], object], repeats: int = 5) -> float:
    """The median of some runs after a first one that compiles and fills caches."""
    run()
    took_s = []
    for _ in range(repeats):
        started_s = time.perf_counter()
        run()
        took_s.append(time.perf_counter() - started_s)
    return 1e3 * median(took_s)


def _layer(camera: Camera, box: tuple[int, int, int, int]) -> Layer:
    top, left, height, width = box
    alpha = np.zeros((camera.height_px, camera.width_px), np.float32)
    alpha[top : top + height, left : left + width] = 1.0
    rgb = np.random.default_rng(0).uniform(0.0, 1.0, (*alpha.shape, 3)).astype(np.float32) * alpha[..., None]
    return Layer(rgb, alpha, np.where(alpha > 0, np.float32(2.0), np.float32(np.inf)))


def _remap_ms(layer: Layer, wide: Camera) -> float:
    box = _reached_box(lit_box(layer), wide, PLATE, DISTORTION)
    positions = (sampled_positions_px(DISTORTION, PLATE, wide, box)[1:-1, 1:-1] - 0.5).astype(np.float32)
    values = np.dstack([layer.rgb, layer.alpha])
    return _milliseconds(lambda: cv2.remap(values, positions[..., 0], positions[..., 1], cv2.INTER_LINEAR))


def _warps() -> None:
    wide = overscan_camera(PLATE, DISTORTION)
    print(f"overscan of a 1920x1080 plate: {wide.width_px}x{wide.height_px}")
    for name, box in BOXES.items():
        layer = _layer(wide, box)
        moving = with_motion(layer, np.ones((*layer.alpha.shape, 2), np.float32))
        plain_ms, moving_ms = (_milliseconds(lambda each=each: distorted(each, wide, PLATE, DISTORTION)) for each in (layer, moving))
        remap_ms = _remap_ms(layer, wide)
        print(
            f"box {name}: {plain_ms:.0f} ms, with motion {moving_ms:.0f} ms; remap alone {remap_ms:.0f} ms, ratio {plain_ms / remap_ms:.1f}"
        )


def _motion() -> None:
    scene = load_glb(ALIEN).without_lights()
    scene = scene.transformed(world_from_scene_placing(scene, (0.0, 0.3, 2.0), 0.6)).with_lights(sun((0.3, 1.0, 0.5), 3.0))

    def scene_at(time_s: float) -> Scene:
        shift = np.eye(4)
        shift[:3, 3] = (2.0 * time_s, 0.5 * time_s, 0.0)
        return scene.transformed(shift)

    renderer = EmbreeRaycaster()
    whole, rolling = (FilmedScene(scene_at, lambda _: PLATE, ShutterTiming(24.0, readout_s=readout_s)) for readout_s in (0.0, 0.02))
    sharp_ms = _milliseconds(lambda: renderer.render(scene_at(0.0), PLATE))
    print(f"sharp picture {sharp_ms:.0f} ms")
    print(f"with motion channels {_milliseconds(lambda: moving_layer(renderer, whole, 0.0)):.0f} ms")
    print(f"with motion channels, rolling {_milliseconds(lambda: moving_layer(renderer, rolling, 0.0)):.0f} ms")
    print(f"average of 16 moments {_milliseconds(lambda: accumulated(renderer.render, whole, 0.0, 16), 1):.0f} ms")


def main() -> None:
    print(machine_line())
    _warps()
    _motion()
    print(memory_line())


if __name__ == "__main__":
    main()
