"""How exact and how fast dense depth is: `python -m tests.bench.bench_plane_sweep`.

The traced lab (seven views of 960x640 px, depth known), with 1 % shot noise. Yardsticks in the same run: OpenCV's StereoSGBM (HH) on
one rectified pair 77 mm apart, and a plain plane sweep from OpenCV's pieces, remap and boxFilter, with the same
planes, windows and choice of neighbours but no labelling.
"""

import time
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np

from capture.dense.dense_depth import DenseSettings, dense_depth
from capture.dense.plane_sweep import Matching, dioptre_planes, window_statistics
from capture.dense.sweep_view import SweepView, neighbour_from_reference, packed_view, rays_of, structure_of
from datasets_scripts.scenes.stack_scenes import LAB_NEAR_M, LAB_VIEWPOINTS, lab_camera, lab_scene
from datasets_scripts.tracers.thin_lens import trace_pinhole
from mrbokeh.optics.lens import Lens
from tests.bench.machine import machine_line, memory_line

WIDTH_PX, HEIGHT_PX, SAMPLES = 960, 640, 32
NOISE = 0.01
PARTNER = 1
RANGE = (0.45, 1.95)


def main() -> None:
    rgb, views, depth_m = _lab()
    true = 1.0 / depth_m
    neighbours = views[1:]
    print(f"{WIDTH_PX}x{HEIGHT_PX} px, {len(neighbours)} neighbours, {NOISE:.0%} noise; errors in dioptres; CPU is processor time")
    for planes in (96, 128):
        settings = DenseSettings(most_planes=planes)
        found, cpu_s, wall_s = _timed(lambda chosen=settings: dense_depth(rgb, views[0], neighbours, RANGE, settings=chosen))
        _line(f"dense_depth, {planes} planes", 1.0 / found.depth_m, true, cpu_s, wall_s)
        sure = found.confidence > 0.5
        _line("  its confidence > 0.5", np.where(sure, 1.0 / found.depth_m, np.nan), true, cpu_s, wall_s)
    planes_96 = dioptre_planes(views[0], neighbours, RANGE, most=96)
    swept, cpu_s, wall_s = _timed(lambda: _opencv_sweep(views[0], neighbours, planes_96, Matching()))
    _line("OpenCV remap + boxFilter, 96 planes", swept, true, cpu_s, wall_s)
    matched, cpu_s, wall_s = _timed(lambda: _opencv_sgbm(views[0], views[PARTNER]))
    _line("OpenCV StereoSGBM (HH), one pair", matched, true, cpu_s, wall_s)
    print(memory_line())
    print(machine_line())


def _lab() -> tuple[np.ndarray, list[SweepView], np.ndarray]:
    """(RGB of the reference, all views with noise, depth of the reference)."""
    scene, rng = lab_scene(1), np.random.default_rng(0)
    lens = Lens(28.0, 2.8, LAB_NEAR_M, 23.5)
    views, pictures, depths = [], [], []
    for number in range(len(LAB_VIEWPOINTS)):
        camera = lab_camera(number, WIDTH_PX, HEIGHT_PX, lens)
        rgb, depth_m = trace_pinhole(scene, camera, SAMPLES, number, 1.5)
        rgb += NOISE * np.sqrt(np.maximum(rgb, 0.0)) * rng.normal(size=rgb.shape).astype(np.float32)
        views.append(SweepView(structure_of(rgb), camera))
        pictures.append(rgb)
        depths.append(depth_m)
    return pictures[0], views, depths[0]


def _timed(run: Callable[[], Any]) -> tuple[Any, float, float]:
    """(result, CPU seconds, seconds) of the second of two runs: the first compiles."""
    run()
    cpu_s, wall_s = time.process_time(), time.perf_counter()
    result = run()
    return result, time.process_time() - cpu_s, time.perf_counter() - wall_s


def _line(name: str, dioptre: np.ndarray, true: np.ndarray, cpu_s: float, wall_s: float) -> None:
    known = np.isfinite(dioptre)
    error = np.abs(dioptre - true)[known]
    print(
        f"  {name:36s} known {known.mean():4.0%}  median {np.median(error / true[known]):.3%} of the depth  mean {error.mean():.4f}"
        f"  > 0.05: {np.mean(error > 0.05):.1%}  CPU {cpu_s:.1f} s, {wall_s:.1f} s"
    )


def _opencv_sweep(reference: SweepView, neighbours: list[SweepView], planes: np.ndarray, matching: Matching) -> np.ndarray:
    """Dioptre of the best plane at each pixel, by OpenCV's calls alone."""
    structure, size = reference.structure, (2 * matching.radius_px + 1,) * 2
    mean, variance = window_statistics(structure, matching.radius_px)
    rays, noise = rays_of(reference), matching.noise**2
    best = np.full(structure.shape, -2.0, np.float32)
    dioptre = np.zeros(structure.shape, np.float32)
    packed = [packed_view(reference, each) for each in neighbours]
    for plane in planes:
        scores = []
        for neighbour, view in zip(neighbours, packed, strict=True):
            x, y, z = (rays @ view[3 * row : 3 * row + 2] + (view[3 * row + 2] + np.float32(plane) * view[9 + row]) for row in range(3))
            warped = cv2.remap(neighbour.structure, x / z * view[12] + view[14], y / z * view[13] + view[15], cv2.INTER_LINEAR)
            w, ww, rw = (cv2.boxFilter(each, -1, size) for each in (warped, warped * warped, warped * structure))
            scores.append((rw - mean * w) / np.sqrt((variance + noise) * (np.maximum(ww - w * w, 0.0) + noise)))
        score = np.sort(np.stack(scores), axis=0)[-matching.best_of(len(neighbours)) :].mean(axis=0)
        dioptre[score > best] = plane
        best = np.maximum(best, score)
    return dioptre


def _opencv_sgbm(reference: SweepView, partner: SweepView) -> np.ndarray:
    """Dioptre at each pixel of the reference, NaN where unknown: rectified, matched, and led back to its own pixels."""
    size = (WIDTH_PX, HEIGHT_PX)
    k = [
        np.array([[c.focal_px[0], 0, c.principal_px[0] - 0.5], [0, c.focal_px[1], c.principal_px[1] - 0.5], [0, 0, 1]])
        for c in (reference.camera, partner.camera)
    ]
    pose, none = neighbour_from_reference(reference.camera, partner.camera), np.zeros(5)
    r1, r2, p1, p2, *_ = cv2.stereoRectify(k[0], none, k[1], none, size, pose[:3, :3].copy(), pose[:3, 3].reshape(3, 1).copy(), alpha=0.0)
    pictures = []
    for view, matrix, turn, projection in ((reference, k[0], r1, p1), (partner, k[1], r2, p2)):
        x, y = cv2.initUndistortRectifyMap(matrix, none, turn, projection, size, cv2.CV_32FC1)
        pictures.append(cv2.remap((255.0 * np.clip(view.structure / 1.1, 0, 1)).astype(np.uint8), x, y, cv2.INTER_LINEAR))
    focal_baseline = -float(p2[0, 3])  # positive where the partner stands to the right
    ends = [focal_baseline * d + float(p2[0, 2] - p1[0, 2]) * -1.0 for d in RANGE]
    least = int(np.floor(min(ends))) - 16
    count = int(np.ceil((max(ends) - least + 16) / 16.0)) * 16
    matcher = cv2.StereoSGBM_create(least, count, 5, 8 * 25, 32 * 25, 1, 0, 10, 100, 2, cv2.STEREO_SGBM_MODE_HH)
    disparity = matcher.compute(*pictures).astype(np.float32) / 16.0
    known = disparity > least
    dioptre = np.where(known, (disparity + float(p2[0, 2] - p1[0, 2])) / focal_baseline, np.nan).astype(np.float32)
    return _from_rectified(dioptre, r1, p1, rays_of(reference))


def _from_rectified(dioptre: np.ndarray, turn: np.ndarray, projection: np.ndarray, rays: np.ndarray) -> np.ndarray:
    """1 / depth along the reference's own axis from that along the rectified one."""
    points = np.concatenate([rays, np.ones_like(rays[..., :1])], axis=-1) @ turn.T
    x = (points[..., 0] / points[..., 2] * projection[0, 0] + projection[0, 2]).astype(np.float32)
    y = (points[..., 1] / points[..., 2] * projection[1, 1] + projection[1, 2]).astype(np.float32)
    there = cv2.remap(dioptre, x, y, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=float("nan"))
    return there * points[..., 2].astype(np.float32)


if __name__ == "__main__":
    main()
