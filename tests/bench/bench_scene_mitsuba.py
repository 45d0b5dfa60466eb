"""How long a path-traced object takes: `python -m tests.bench.bench_scene_mitsuba`.

The FlightHelmet of Khronos (../shared/data/objects) at 640x360 under a panorama with a sun, 64 paths per pixel, beside the ray
caster's picture of it; then the change of light on the table below it. Processor time counts all threads.
"""

import sys
from collections.abc import Callable
from functools import partial

import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Environment, Scene, shadow_catcher, sun, world_from_scene_placing
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.gltf.gltf_loader import load_glb
from mrbokeh.scene.light import directions
from mrbokeh.scene.light_change import light_change
from mrbokeh.scene.mitsuba.mitsuba_tracer import MitsubaTracer
from tests.bench.machine import tell, took
from tests.conftest import SHARED_DATA

CAMERA = Camera(640, 360, (620.0, 615.0), (318.0, 182.0))


def helmet() -> Scene:
    """The helmet standing 1.1 m in front of the camera, 0.55 m high: about a seventh of the picture."""
    scene = load_glb(SHARED_DATA / "objects" / "FlightHelmet.glb").without_lights()
    scene = scene.transformed(world_from_scene_placing(scene, (0.0, 0.28, 1.1), height_m=0.55, turn_rad=0.4))
    return scene.with_environment(Environment(sky())).with_lights(sun((0.5, 1.0, 0.6), 3.0))


def sky() -> np.ndarray:
    """A panorama of 512x1024 with a gradient and a wide lamp."""
    towards = directions(512, 1024)
    lamp = 20.0 * np.exp(60 * (towards @ np.array([0.6, -0.64, -0.48]) - 1))
    return (np.stack([0.4 + 0.3 * -towards[..., 1]] * 3, axis=-1) + lamp[..., None]).astype(np.float32)


def timed(work: Callable[[], object]) -> tuple[float, float]:
    """(wall s, processor s)."""
    wall_ms, cpu_ms = took(work)
    return wall_ms / 1e3, cpu_ms / 1e3


def main() -> None:
    if not SHARED_DATA.is_dir():
        sys.exit("the FlightHelmet is missing: it lies in ../shared/data/objects beside the checkout")
    scene, tracer, caster = helmet(), MitsubaTracer(samples=64), EmbreeRaycaster()
    covered = float((caster.render(scene, CAMERA).alpha > 0).mean())
    print(f"FlightHelmet: {sum(len(mesh.triangles) for mesh in scene.meshes)} triangles, {covered:.0%} of 640x360 covered")
    print(
        "first picture of a session (compiling or loading kernels, hierarchy): {:.1f} s, {:.1f} s of processor".format(
            *timed(lambda: tracer.render(scene, CAMERA))
        )
    )
    wall_s, processor_s = timed(lambda: tracer.render(scene, CAMERA))
    paths_s = processor_s
    direct_wall_s, direct_processor_s = timed(lambda: MitsubaTracer(samples=64, most_bounces=1).render(scene, CAMERA))
    seen_s = processor_s / (covered * CAMERA.width_px * CAMERA.height_px * 64 / 1e6)
    cast_wall_s, cast_processor_s = min(timed(lambda: caster.render(scene, CAMERA)) for _ in range(3))
    print(f"64 paths per pixel, 6 bounces: {wall_s:.1f} s, {processor_s:.1f} s of processor")
    print(f"{seen_s:.2f} s of processor per million paths: {seen_s * 14.7:.0f} s where the whole of 640x360 is covered")
    print(f"64 paths per pixel, direct light: {direct_wall_s:.1f} s, {direct_processor_s:.1f} s of processor")
    print(f"yardstick, the ray caster (no light passed on): {cast_wall_s:.2f} s, {cast_processor_s:.2f} s of processor")
    catcher = shadow_catcher(0.28, (0.0, 1.1), 4.0)
    for renderer, name in ((tracer, "64 paths per pixel and way"), (caster, "the ray caster")):
        wall_s, processor_s = timed(partial(light_change, renderer, scene, CAMERA, catcher))
        print(f"change of light on the table, {name}: {wall_s:.1f} s, {processor_s:.1f} s of processor")
    print(f"paths / ray caster: {paths_s / cast_processor_s:.0f} (processor)")
    tell()


if __name__ == "__main__":
    main()
