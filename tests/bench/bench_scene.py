"""How long a virtual object takes: `python -m tests.bench.bench_scene`.

640x360 with the sun's shadow and a panorama. The yardstick in the same run is trimesh's own ray caster (its Embree wrapper)
with shading in numpy: first hit, interpolated normal, Lambert and one shadow ray per pixel; no textures, no edges, no panorama.
Where wgpu finds a device (Mesa's in software counts) the rasteriser is timed beside the ray caster, also on a textured ball of
20 000 triangles at 640x360 and 1280x720.
"""

import time
from collections.abc import Callable
from functools import partial

import numpy as np
import trimesh

from mrbokeh.optics.camera import Camera
from mrbokeh.scene import Environment, Material, Scene, Texture, matte, rectangle, shadow_catcher, sphere, sun
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.light import directions
from mrbokeh.scene.wgpu.device import gpu
from mrbokeh.scene.wgpu.wgpu_rasterizer import WgpuRasterizer
from mrbokeh.system.errors import InputError
from tests.bench.machine import machine_line, memory_line

CAMERA = Camera(640, 360, (520.0, 515.0), (320.0, 180.0))
SUN = sun((0.5, 1.0, 0.3), 3.0)


def balls_on_a_floor() -> Scene:
    """Nine glossy and matte balls on a floor that fills half of the picture: about 75 000 triangles."""
    floor = rectangle((-10, 0.6, 12), (20, 0, 0), (0, 0, -11), matte(0.5, 0.5, 0.5))
    balls = [
        sphere((x, 0.25, z), 0.35, Material(base_color=(0.8, 0.5, 0.3, 1.0), metallic=metallic, roughness=0.1 + 0.1 * z), rows=46)
        for x, metallic in ((-1.0, 0.0), (0.0, 0.5), (1.0, 1.0))
        for z in (2.0, 3.0, 4.0)
    ]
    return Scene((floor, *balls), (SUN,), Environment(sky()))


def sky() -> np.ndarray:
    """A panorama of 512x1024 with a gradient and a wide lamp."""
    towards = directions(512, 1024)
    lamp = 20.0 * np.exp(60 * (towards @ np.array([0.6, -0.64, -0.48]) - 1))
    return (np.stack([0.4 + 0.3 * -towards[..., 1]] * 3, axis=-1) + lamp[..., None]).astype(np.float32)


def trimesh_lambert(scene: Scene, camera: Camera) -> np.ndarray:
    """The yardstick: trimesh's intersector, Lambert under the sun with hard shadow."""
    world = trimesh.util.concatenate(
        [trimesh.Trimesh(mesh.positions_m, mesh.triangles, vertex_normals=mesh.normals, process=False) for mesh in scene.meshes]
    )
    eye = camera.world_from_camera[:3, 3]
    rays = camera.unproject(camera.pixel_centres_px().reshape(-1, 2), np.ones(camera.height_px * camera.width_px)) - eye
    place, ray, triangle = world.ray.intersects_location(np.broadcast_to(eye, rays.shape), rays, multiple_hits=False)
    weights = trimesh.triangles.points_to_barycentric(world.triangles[triangle], place)
    normal = np.einsum("ij,ijk->ik", weights, world.vertex_normals[world.faces[triangle]])
    towards = -np.asarray(SUN.direction)
    lit = ~world.ray.intersects_any(place + 1e-4 * normal, np.broadcast_to(towards, place.shape))
    shade = np.zeros(len(rays))
    shade[ray] = 0.5 / np.pi * SUN.rgb[0] * np.maximum(normal @ towards, 0.0) * lit
    return shade


def best_of(work: Callable[[], object], times: int = 5) -> tuple[float, float]:
    """(wall ms, processor ms) of the fastest run."""
    runs = []
    for _ in range(times):
        wall_s, processor_s = time.perf_counter(), time.process_time()
        work()
        runs.append((time.perf_counter() - wall_s, time.process_time() - processor_s))
    return 1e3 * min(run[0] for run in runs), 1e3 * min(run[1] for run in runs)


def textured_ball() -> Scene:
    """20 000 triangles with a base colour and a roughness texture, a sixth of the picture."""
    texels = np.random.default_rng(1).uniform(0.1, 0.9, (1024, 1024, 3)).astype(np.float32)
    painted = Material(base_color_texture=Texture(texels), metallic_roughness_texture=Texture(texels))
    return Scene((sphere((0.0, 0.0, 2.0), 0.42, painted, rows=71),), (SUN,), Environment(sky()))


def beside_the_rasterizer() -> None:
    """Both backends in the same run; processor time counts Mesa's threads too."""
    try:
        rasterizer = WgpuRasterizer()
    except InputError as no_device:
        print(f"rasteriser: {no_device}")
        return
    print(f"rasteriser on {gpu().name}")
    for name, scene in (("balls on a floor", balls_on_a_floor()), ("textured ball", textured_ball())):
        for camera in (CAMERA, CAMERA.resized(1280, 720)):
            rows = []
            for backend in (rasterizer, EmbreeRaycaster()):
                backend.render(scene, camera)
                rows.append(best_of(partial(backend.render, scene, camera)))
            (fast_ms, fast_processor_ms), (slow_ms, slow_processor_ms) = rows
            print(
                f"{name}, {camera.width_px}x{camera.height_px}: rasteriser {fast_ms:.0f} ms ({fast_processor_ms:.0f} of processor), "
                f"ray caster {slow_ms:.0f} ms ({slow_processor_ms:.0f}); ray caster / rasteriser {slow_ms / fast_ms:.2f}"
            )


def main() -> None:
    scene, backend = balls_on_a_floor(), EmbreeRaycaster()
    catcher = shadow_catcher(0.6, (0.0, 5.0), 10.0)
    before_s = time.perf_counter()
    layer = backend.render(scene, CAMERA)
    first_s = time.perf_counter() - before_s
    wall_ms, processor_ms = best_of(lambda: backend.render(scene, CAMERA))
    mask_wall_ms, mask_processor_ms = best_of(lambda: backend.render_shadow_mask(scene, CAMERA, catcher))
    live = backend.with_quality(edge_samples=4, shadow_step_px=2)
    live_wall_ms, live_processor_ms = best_of(lambda: (live.render(scene, CAMERA), live.render_shadow_mask(scene, CAMERA, catcher)))
    yard_wall_ms, yard_processor_ms = best_of(lambda: trimesh_lambert(scene, CAMERA), times=2)
    count = sum(len(mesh.triangles) for mesh in scene.meshes)
    print(f"scene: {count} triangles, {layer.alpha.mean():.0%} of 640x360 covered, sun and panorama")
    print(f"first picture (compiling or loading kernels, hierarchy, panorama): {first_s:.2f} s")
    print(f"picture with shadows: {wall_ms:.0f} ms, {processor_ms:.0f} ms of processor time")
    print(f"shadow mask on a catcher: {mask_wall_ms:.0f} ms, {mask_processor_ms:.0f} ms of processor time")
    print(f"both with 4 rays at edges and half the shadow's pixels: {live_wall_ms:.0f} ms, {live_processor_ms:.0f} ms of processor time")
    print(f"yardstick trimesh + numpy Lambert: {yard_wall_ms:.0f} ms, {yard_processor_ms:.0f} ms of processor time")
    print(f"yardstick / picture: {yard_wall_ms / wall_ms:.2f} (wall), {yard_processor_ms / processor_ms:.2f} (processor)")
    beside_the_rasterizer()
    print(memory_line())
    print(machine_line())


if __name__ == "__main__":
    main()
