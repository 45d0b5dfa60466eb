"""How long polygonal differences take: `python -m tests.bench.bench_polygon_differences`.

The yardstick is OpenCV's Gaussian blur (sigma 10) of the same frame, with as many threads, measured in turns with each row.
GEGL's lens-blur (Debian package gegl), a scatter with one disc for all pixels, is run by its command line on the same
frame; what the command takes to load and save the frame is measured with gegl:nop and subtracted.
"""

import os
import re
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from mrbokeh.images.image_io import write_image
from mrbokeh.images.layer import opaque
from mrbokeh.layering.layering import Layering
from mrbokeh.optics.aperture import Aperture
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from tests.bench.machine import in_turns, machine_line, took

OCTAGON = Aperture.blades(8, np.pi / 8)
FULL_HD, QUARTER_HD, ULTRA_HD = (1080, 1920), (360, 640), (2160, 3840)
REPEATS = 7
FRAMES = 60
GEGL_RADIUS_PX = 64


def frame(size: tuple[int, int], darkest: float = 0.05) -> np.ndarray:
    """Texture from `darkest` to 1 in four channels, coverage 1."""
    values = np.random.default_rng(0).uniform(darkest, 1.0, (*size, 4)).astype(np.float32)
    values[..., 3] = 1.0
    return values


def diameters_px(size: tuple[int, int], largest_px: float) -> np.ndarray:
    """Smooth hills of circles of confusion from 0 to the largest, with a texture of 1 % of it."""
    y, x = np.mgrid[: size[0], : size[1]] * (1080.0 / size[0])
    noise = cv2.GaussianBlur(np.random.default_rng(1).standard_normal(size).astype(np.float32), (0, 0), 3)
    hills = 0.5 + 0.5 * np.sin(x / 300.0) * np.cos(y / 200.0) + 0.01 * noise / noise.std()
    return (np.clip(hills, 0.0, 1.0) * largest_px).astype(np.float32)


def row(name: str, run: Callable[[], object], values: np.ndarray) -> float:
    took_ms, yardstick_ms = (each.wall_ms for each in in_turns(run, lambda: cv2.GaussianBlur(values, (0, 0), 10), repeats=REPEATS))
    print(f"{name:<68} {took_ms:8.1f} ms  {took_ms / yardstick_ms:5.2f} of GaussianBlur ({yardstick_ms:.1f} ms)")
    return took_ms


def spread_rows() -> None:
    values, dark = frame(FULL_HD), frame(FULL_HD, darkest=0.0)
    dark[:, :400, :3] *= 0.001
    took_ms = {}
    for largest_px in (40.0, 121.0, 400.0):
        coc_px, renderer = diameters_px(FULL_HD, largest_px), PolygonDifferences()
        took_ms[largest_px] = row(
            f"1920x1080, octagon, to {largest_px:g} px", lambda c=coc_px, r=renderer: r.sum_kernels(values, c, OCTAGON), values
        )
    print(f"{'the largest over the smallest of these':<68} {took_ms[400.0] / took_ms[40.0]:8.2f}")
    coc_px = diameters_px(FULL_HD, 121.0)
    for name, aperture, light in (
        ("octagon, deep shadows: double precision", OCTAGON, dark),
        ("disc of 16 edges", Aperture.disc(), values),
    ):
        renderer = PolygonDifferences()
        row(f"1920x1080, {name}, to 121 px", lambda a=aperture, v=light, r=renderer: r.sum_kernels(v, coc_px, a), light)


def render_row() -> None:
    """A whole frame of 8 slices, with hidden background and all."""
    values, coc_px = frame(QUARTER_HD), diameters_px(QUARTER_HD, 30.0) - 10.0
    lens = Lens(100.0, 1.2, 2.0, 36.0, OCTAGON)
    depth_m = (1.0 / (1.0 / lens.focus_distance_m - coc_px / lens.coc_px_per_dioptre(QUARTER_HD[1]))).astype(np.float32)
    layer, renderer = opaque(np.ascontiguousarray(values[..., :3]), depth_m), PolygonDifferences(layering=Layering(slices=8))
    renderer.render([layer], lens)
    took_ms = [took(lambda: renderer.render([layer], lens)).wall_ms for _ in range(FRAMES)]
    name = f"640x360, octagon, -10 to 20 px, render of 8 slices, {FRAMES} frames on end"
    print(f"{name:<68} {statistics.median(took_ms):8.1f} ms  {1e3 * FRAMES / sum(took_ms):5.1f} frames per second")
    row("the same in turns with the blur of a frame, which empties the caches", lambda: renderer.render([layer], lens), values)
    spreads_ms: list[float] = []

    def timed(*arguments: np.ndarray) -> np.ndarray:
        started_s = time.perf_counter()
        result = PolygonDifferences.sum_kernels(renderer, *arguments)
        spreads_ms.append(1e3 * (time.perf_counter() - started_s))
        return result

    from mrbokeh.layering.layering import render_layers

    render_layers([layer], lens, timed, renderer.layering)
    print(f"{'':<68} {sum(spreads_ms):8.1f} ms of these in its {len(spreads_ms)} spreads")


def gegl_row(own_ms: float) -> None:
    name = f"1920x1080, GEGL lens-blur, radius {GEGL_RADIUS_PX} px"
    if shutil.which("gegl") is None:
        print(f"{name:<68} not measured: the command gegl is not installed (Debian package gegl)")
        return
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "frame.exr", Path(folder) / "out.exr"
        write_image(source, np.ascontiguousarray(frame(FULL_HD)[..., :3]), half=False)

        def run(*operation: str) -> float:
            return took(lambda: subprocess.run(["gegl", source, "-o", target, "--", *operation], check=True, capture_output=True)).wall_ms

        nop_ms = statistics.median(run("gegl:nop") for _ in range(REPEATS))
        took_ms = statistics.median(run("gegl:lens-blur", f"radius={GEGL_RADIUS_PX}") for _ in range(REPEATS)) - nop_ms
    print(f"{name:<68} {took_ms:8.0f} ms  {took_ms / own_ms:5.1f} times ours at 128 px ({own_ms:.1f} ms)")


def memory_row() -> None:
    """In a process of its own, which makes the frame, spreads it and tells its peak."""
    done = subprocess.run(
        [sys.executable, "-m", "tests.bench.bench_polygon_differences", "--peak"], check=True, capture_output=True, text=True
    )
    base_mb, peak_mb = map(float, re.findall(r"[\d.]+", done.stdout))
    print(f"{'3840x2160, octagon, to 400 px: peak memory of the process':<68} {peak_mb:8.0f} MB, {base_mb:.0f} MB before the spread")


def print_peak() -> None:
    import resource

    values, coc_px = frame(ULTRA_HD), diameters_px(ULTRA_HD, 400.0)
    before_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    PolygonDifferences(precision="double").sum_kernels(values, coc_px, OCTAGON)
    print(before_mb, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)


def main() -> None:
    print(f"all cores ({os.cpu_count()}), medians of {REPEATS}; load before the run {os.getloadavg()[0]:.1f}")
    spread_rows()
    render_row()
    values, coc_px, renderer = frame(FULL_HD), np.full(FULL_HD, 2.0 * GEGL_RADIUS_PX, np.float32), PolygonDifferences()
    gegl_row(row("1920x1080, octagon, 128 px for all pixels", lambda: renderer.sum_kernels(values, coc_px, OCTAGON), values))
    memory_row()
    print(machine_line())


if __name__ == "__main__":
    print_peak() if "--peak" in sys.argv else main()
