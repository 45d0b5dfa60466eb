"""What the live virtual object costs and how good its late reprojection is: `python -m tests.bench.bench_stage`.

640x360, one textured object of 21 896 triangles (the leather parts of shared/data/objects/FlightHelmet.glb; the whole helmet
has 94 700) with its shadow on the table, blurred by an f/2 lens, everything in one thread. The yardstick of the warp is OpenCV's remap
of the same pixels with the map known already; the yardstick of its quality is the old drawing left where it was.
"""

import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np

from mrbokeh.compositing.overlay import code_tables
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.scene import Environment, Scene
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.environment_filter import lighting_maps
from mrbokeh.scene.gltf.gltf_loader import GltfAsset
from mrbokeh.scene.staging.scene_description import PlacedObject, SceneDescription, ShadowPlane
from mrbokeh.scene.staging.staged_scene import Assets, StagedObject, StagedScene
from mrbokeh.tracking.world_axes import upright_camera
from tests.bench.machine import machine_line, memory_line
from tests.scenes.stage_scenes import looking
from viewfinder.stage.drawing import Drawing, DrawRequest, RenderSetup, draw
from viewfinder.stage.reprojection import LayerDepth
from viewfinder.stage.stage import RESOLUTIONS, Stage
from viewfinder.stage.stage_setup import live_backend, live_renderer
from viewfinder.tracking.tracker import TrackedPose

LENS = Lens(focal_length_mm=50.0, f_number=2.0, focus_distance_m=0.8, sensor_width_mm=36.0)
WIDTH, HEIGHT = 640, 360
TRIANGLES = 22_000
HELMET = Path(__file__).resolve().parents[3] / "shared" / "data" / "objects" / "FlightHelmet.glb"
STEPS_MS = (33, 66, 125)


class PartOfAsset(GltfAsset):
    """The largest meshes of a file that together have at most so many triangles."""

    def scene_at(self, time_s: float = 0.0, animation: str | int | None = None) -> Scene:
        scene, kept, count = super().scene_at(time_s, animation), [], 0
        for mesh in sorted(scene.meshes, key=lambda each: -len(each.triangles)):
            if count + len(mesh.triangles) <= TRIANGLES:
                kept.append(mesh)
                count += len(mesh.triangles)
        return replace(scene, meshes=tuple(kept))


def helmet(asset: type[GltfAsset] = PartOfAsset) -> StagedScene:
    placed = PlacedObject("helmet", HELMET, height_m=0.3)
    described = SceneDescription(Path("scene.toml"), objects=(placed,), shadow=ShadowPlane(size_m=1.0))
    return StagedScene(described, (StagedObject(placed, asset(HELMET), "-z"),), Assets().light(described.light, "-z"))


def hand_held(time_s: float) -> Camera:
    """A hand that follows the object: 0.15 m/s sideways, 0.05 m/s forward, 5 degrees per second of unrest, about 1 m away."""
    eye = (0.15 * time_s, 0.95 - 0.05 * time_s, -0.35 + 0.02 * np.sin(9 * time_s))
    at = (0.087 * np.sin(time_s), 0.0, -0.12 + 0.03 * np.sin(5 * time_s))
    return Camera(WIDTH, HEIGHT, (900.0, 900.0), (WIDTH / 2, HEIGHT / 2), looking(eye, at))


def best_ms(work: Callable[[], object], times: int) -> tuple[float, float]:
    """(wall ms, processor ms) of the fastest run."""
    runs = []
    for _ in range(times):
        wall_s, processor_s = time.perf_counter(), time.process_time()
        work()
        runs.append((time.perf_counter() - wall_s, time.process_time() - processor_s))
    return 1e3 * min(run[0] for run in runs), 1e3 * min(run[1] for run in runs)


def psnr_db(result: np.ndarray, truth: np.ndarray, box: tuple[slice, slice]) -> float:
    """Of display-referred light in [0, 1] within the object's box."""
    error = np.clip(result[box], 0.0, 1.0) - np.clip(truth[box], 0.0, 1.0)
    return float(-10.0 * np.log10(np.mean(np.square(error)) + 1e-12))


def main() -> None:
    cv2.setNumThreads(1)
    raycaster, staged = EmbreeRaycaster(threads=1), helmet()
    render_setup = RenderSetup(raycaster, live_renderer("polygon"), LayerDepth(), live=live_backend(raycaster))

    def drawn(time_s: float, resolution: float = 1.0) -> Drawing:
        return draw(staged, DrawRequest(hand_held(time_s), LENS, 0.0, resolution), render_setup)

    started_s = time.perf_counter()
    first = drawn(0.0)
    print(f"scene: {sum(each.triangle_count for each in staged.objects)} triangles; first drawing {time.perf_counter() - started_s:.2f} s")
    print_rates(staged, render_setup)
    print_price_of_speed(staged, render_setup)
    print_warp(first)
    for step_ms in STEPS_MS:
        print_quality(drawn, step_ms / 1e3)
    whole = helmet(GltfAsset)
    print(f"the whole helmet: {sum(each.triangle_count for each in whole.objects)} triangles")
    print_rates(whole, render_setup)
    print_changes(whole, render_setup)
    print_stream()
    print(memory_line())
    print(machine_line())


def print_rates(staged: StagedScene, render_setup: RenderSetup) -> None:
    for resolution in RESOLUTIONS:
        request = DrawRequest(hand_held(0.0), LENS, 0.0, resolution)
        draw(staged, request, render_setup)
        wall_ms, processor_ms = best_ms(partial(draw, staged, request, render_setup), 9)
        rate = f"{1e3 / processor_ms:.1f} per second of it"
        print(f"drawing at {resolution:.2f} of the pixels: {wall_ms:.0f} ms, {processor_ms:.0f} ms of processor time, {rate}")


def print_price_of_speed(staged: StagedScene, render_setup: RenderSetup) -> None:
    """The live backend beside the one for captures: time, and the picture over a grey plate."""
    request, view, plate = (
        DrawRequest(hand_held(0.0), LENS),
        upright_camera(hand_held(0.0), "-z"),
        np.full((HEIGHT, WIDTH, 3), 0.2, np.float32),
    )
    best, pictures = replace(render_setup, live=None), []
    for each in (render_setup, best):
        layer = draw(staged, request, each).layer
        assert layer is not None
        pictures.append(layer.moved_to(view).over(plate))
    _, processor_ms = best_ms(partial(draw, staged, request, best), 5)
    near_db = psnr_db(pictures[0], pictures[1], np.s_[:, :])
    print(f"with 16 rays at edges and the whole shadow: {processor_ms:.0f} ms; the live picture is {near_db:.1f} dB near it")


def print_changes(staged: StagedScene, render_setup: RenderSetup) -> None:
    """What a scene that was changed costs before its first drawing, and with it."""
    request, moved = DrawRequest(hand_held(0.0), LENS, 0.0, 0.5), staged
    steady_ms = best_ms(partial(draw, staged, request, render_setup), 3)[1]
    took_ms = []
    for number in range(5):
        started_s = time.process_time()
        moved = moved.with_object("helmet", position_m=(0.01 * number, 0.0, 0.0), yaw_rad=0.1 * number)
        draw(moved, request, render_setup)
        took_ms.append(1e3 * (time.process_time() - started_s) - steady_ms)
    print(f"moving it costs {min(took_ms):.0f} ms of processor time beside the drawing itself")
    panorama = Environment(np.random.default_rng(1).uniform(0.0, 1.0, (512, 1024, 3)).astype(np.float32))
    for name, light in (("new", panorama), ("brighter", panorama.brighter(1.5)), ("turned", panorama.turned(0.3))):
        started_s = time.process_time()
        lighting_maps(light)
        print(f"{name} panorama of 1024x512 px: {1e3 * (time.process_time() - started_s):.0f} ms of processor time")


def print_warp(drawing: Drawing) -> None:
    layer, view = drawing.layer, upright_camera(hand_held(0.066), "-z")
    assert layer is not None
    overlay = layer.moved_to(view)
    (height, width), (rows, columns) = overlay.shines_through.shape, layer.rgba.shape[:2]
    warp_ms, processor_ms = best_ms(lambda: layer.moved_to(view), 40)
    x, y = (each.astype(np.float32) for each in np.meshgrid(np.linspace(0, columns, width), np.linspace(0, rows, height)))
    remap_ms, _ = best_ms(lambda: cv2.remap(layer.rgba, x, y, cv2.INTER_LINEAR), 40)
    per_px_ns = 1e6 * warp_ms / (width * height)
    print(f"warp of {width}x{height} px: {warp_ms:.2f} ms, {processor_ms:.2f} ms of processor time, {per_px_ns:.0f} ns per px")
    print(f"yardstick cv2.remap, whose map is known: {remap_ms:.2f} ms; warp / yardstick {warp_ms / remap_ms:.1f}")
    plate, tables = np.full((HEIGHT, WIDTH, 3), 90, np.uint8), code_tables("bt709")
    overlay.over_codes(plate, tables)
    print(f"overlay on the frame (mrbokeh.compositing.overlay): {best_ms(lambda: overlay.over_codes(plate, tables), 40)[0]:.2f} ms")


def print_quality(drawn: Callable[[float], Drawing], step_s: float) -> None:
    """Mean over five moments of the hand's way."""
    plate, late, stale, away_px = np.full((HEIGHT, WIDTH, 3), 0.2, np.float32), [], [], []
    for start_s in np.arange(5) * 0.31:
        old, new = drawn(start_s), drawn(start_s + step_s)
        before, view = upright_camera(hand_held(start_s), "-z"), upright_camera(hand_held(start_s + step_s), "-z")
        assert old.layer is not None and new.layer is not None
        fresh = new.layer.moved_to(view)
        truth, rows, columns = fresh.over(plate), fresh.shines_through.shape[0], fresh.shines_through.shape[1]
        box = np.s_[fresh.top_px : fresh.top_px + rows, fresh.left_px : fresh.left_px + columns]
        late.append(psnr_db(old.layer.moved_to(view).over(plate), truth, box))
        stale.append(psnr_db(old.layer.moved_to(before).over(plate), truth, box))
        middle_m = np.array([0.0, -0.12, 0.0])
        away_px.append(float(np.linalg.norm(before.project(middle_m)[0] - view.project(middle_m)[0])))
    moved = f"{1e3 * step_s:.0f} ms late, {np.mean(away_px):.1f} px of movement"
    print(f"{moved}: {np.mean(late):.1f} dB warped, {np.mean(stale):.1f} dB left where it was")


def print_stream(frames: int = 150) -> None:
    """Frames at 30 per second beside the drawing thread: what the compositing thread waits for."""
    took_ms = []
    with TemporaryDirectory() as folder:
        scene = Path(folder) / "scene.toml"
        scene.write_text(f'[[object]]\nname = "helmet"\nglb = "{HELMET.as_posix()}"\nheight_m = 0.3\n[shadow]\n', encoding="utf-8")
        stage = Stage(scene)
        try:
            while not stage.overlay(pose_at(0.0), hand_held(0.0), LENS, time.monotonic()).shines_through.size:
                time.sleep(0.05)
            begun_s = time.monotonic()
            for number in range(frames):
                time.sleep(max(begun_s + number / 30 - time.monotonic(), 0.0))
                started_s = time.perf_counter()
                stage.overlay(pose_at(number / 30), hand_held(number / 30), LENS, begun_s + number / 30)
                took_ms.append(1e3 * (time.perf_counter() - started_s))
            status = stage.status
        finally:
            stage.close()
    middle, most = np.percentile(took_ms, [50, 95])
    rate = f"{status.draws_per_s:.1f} drawings per second at {status.resolution:.2f} of the pixels"
    print(f"whole helmet ({status.triangles} triangles) in a stream: overlay() p50 {middle:.2f} ms, p95 {most:.2f} ms, {rate}")


def pose_at(time_s: float) -> TrackedPose:
    return TrackedPose(hand_held(time_s).camera_from_world, 1.0, time_s)


if __name__ == "__main__":
    main()
