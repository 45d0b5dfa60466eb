"""How long low-rank filtering takes: `python -m tests.bench.bench_low_rank_filter`.

A picture of 1920x1080 px RGBA with kernels of 33 and 65 px, as in McGraw's Fig. 13. Yardsticks in the same run: full 2D
evaluation, every pixel with its own kernel (what a varying blur needs without this method); OpenCV's filter2D, which for
kernels that large takes the Fourier transform of the picture and can only have one kernel for all of it; and
GaussianBlur(sigma=10).
"""

import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from os import cpu_count
from statistics import median

import cv2
import numpy as np

from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.kernels.low_rank_kernel import aperture_errors
from mrbokeh.renderers.low_rank.exact_scatter import scatter_exactly
from mrbokeh.renderers.low_rank.low_rank_filter import LowRankFilter, tilt_shift
from tests.bench.machine import machine_line, memory_line

HEIGHT_PX, WIDTH_PX = 1080, 1920
DIAMETERS_PX = (32.9, 64.9)
APERTURES = {"disc": Aperture.disc(), "8 blades": Aperture.blades(8, np.pi / 8), "5 blades": Aperture.blades(5, -np.pi / 2)}
REPEATS = 5
_STRIP_ROWS = 64


def _milliseconds(run: Callable[[], object], repeats: int = REPEATS) -> float:
    """The median of some runs after a first one that compiles and fills caches."""
    run()
    took_s = []
    for _ in range(repeats):
        started_s = time.perf_counter()
        run()
        took_s.append(time.perf_counter() - started_s)
    return 1e3 * median(took_s)


def _picture() -> np.ndarray:
    """Texture of all sizes, brightness from 0.02 to 2, with some lights of 100: RGB and a coverage of 1."""
    rng = np.random.default_rng(0)
    rgb = np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.float32)
    for size in (4, 16, 64, 256):
        coarse = rng.uniform(-1, 1, (HEIGHT_PX // size + 2, WIDTH_PX // size + 2, 3)).astype(np.float32)
        rgb += cv2.resize(coarse, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_CUBIC) * size**0.25
    rgb = np.clip(np.exp2(rgb - 1.5), 0.02, 2.0)
    rgb[rng.integers(0, HEIGHT_PX, 60), rng.integers(0, WIDTH_PX, 60)] = 100.0
    return np.dstack([rgb, np.ones((HEIGHT_PX, WIDTH_PX), np.float32)])


def _direct_ms(picture: np.ndarray, diameter_px: float) -> float:
    """Every pixel with its own 2D kernel by our own compiled scatter, on a strip of the picture, scaled to all of it."""
    strip = np.ascontiguousarray(picture[:_STRIP_ROWS])
    out, ones = np.zeros_like(strip), np.ones(strip.shape[:2], np.float32)
    diameters_px = np.full(strip.shape[:2], diameter_px, np.float32)
    with ThreadPoolExecutor(cpu_count()) as pool:
        took_ms = _milliseconds(lambda: scatter_exactly(out, strip, ones, diameters_px, APERTURES["8 blades"], 1, pool.map), 1)
    return took_ms * HEIGHT_PX / _STRIP_ROWS


def main() -> None:
    picture = _picture()
    gauss_ms = _milliseconds(lambda: cv2.GaussianBlur(picture, (0, 0), 10))
    print(f"{WIDTH_PX}x{HEIGHT_PX} RGBA, medians of {REPEATS}; GaussianBlur(sigma=10): {gauss_ms:.0f} ms")
    for diameter_px in DIAMETERS_PX:
        _one_size(picture, diameter_px, gauss_ms)
    print(memory_line())
    print(machine_line())


def _one_size(picture: np.ndarray, diameter_px: float, gauss_ms: float) -> None:
    renderer, paper = LowRankFilter(), LowRankFilter(max_rank=3, per_pixel=True)
    even = np.full((HEIGHT_PX, WIDTH_PX), diameter_px, np.float32)
    down = np.linspace(-1.0, 1.0, HEIGHT_PX, dtype=np.float32)[:, None]
    sliced = np.ascontiguousarray(np.broadcast_to(diameter_px + 2.0 * down, even.shape))
    tilted = np.ascontiguousarray(np.broadcast_to(diameter_px * np.abs(down), even.shape))
    kernel = Aperture.disc().rasterize(diameter_px).kernel.astype(np.float32)
    full_ms = _direct_ms(picture, diameter_px)
    fourier_ms = _milliseconds(lambda: cv2.filter2D(picture, -1, kernel))
    print(f"kernels of {kernel.shape[0]} px: full 2D {full_ms:.0f} ms; one kernel for all by filter2D: {fourier_ms:.0f} ms")
    for name, aperture in APERTURES.items():
        rank = int(np.argmax(aperture_errors(aperture, diameter_px) <= renderer.relative_error)) + 1
        took_ms = _milliseconds(lambda chosen=aperture: renderer.sum_kernels(picture, even, chosen))
        _line(f"one diameter, {name}, rank {max(rank, 4)}", took_ms, full_ms, gauss_ms)
    eight = APERTURES["8 blades"]
    _line("diameters +- 2 px, 8 blades", _milliseconds(lambda: renderer.sum_kernels(picture, sliced, eight)), full_ms, gauss_ms)
    _line("tilt-shift, 8 blades, levels", _milliseconds(lambda: renderer.sum_kernels(picture, tilted, eight)), full_ms, gauss_ms)
    _line(
        "tilt-shift, 8 blades, paper's passes, rank 3",
        _milliseconds(lambda: paper.sum_kernels(picture, tilted, eight), 1),
        full_ms,
        gauss_ms,
    )
    rgb = np.ascontiguousarray(picture[..., :3])
    _line("tilt_shift() as a whole, rank 3", _milliseconds(lambda: tilt_shift(rgb, tilted, eight)), full_ms, gauss_ms)


def _line(what: str, took_ms: float, full_ms: float, gauss_ms: float) -> None:
    print(f"  {what}: {took_ms:.0f} ms, {took_ms / full_ms:.2f} of full 2D, {took_ms / gauss_ms:.2f} of GaussianBlur")


if __name__ == "__main__":
    main()
