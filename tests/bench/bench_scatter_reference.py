"""How long the exact reference takes: `python -m tests.bench.bench_scatter_reference`.

A picture of 640x360 px whose blur grows to 20 px; the yardstick is OpenCV's filter2D with one disc of 20 px for all pixels.
"""

import time
from collections.abc import Callable

import cv2
import numpy as np

from mrbokeh.images.layer import opaque
from mrbokeh.optics.aperture import Aperture
from mrbokeh.renderers.scatter_reference import blur_layer
from tests.bench.machine import machine_line, memory_line

HEIGHT_PX, WIDTH_PX, LARGEST_COC_PX = 360, 640, 20.0
APERTURES = {"disc (64 sides)": Aperture.disc(), "6 blades": Aperture.blades(6), "mirror lens": Aperture.disc().obstructed(0.5)}


def _milliseconds(run: Callable[[], object], repeats: int) -> float:
    run()
    started_s = time.perf_counter()
    for _ in range(repeats):
        run()
    return 1e3 * (time.perf_counter() - started_s) / repeats


def main() -> None:
    rgb = np.random.default_rng(0).uniform(0, 1, (HEIGHT_PX, WIDTH_PX, 3)).astype(np.float32)
    layer = opaque(rgb, np.ones((HEIGHT_PX, WIDTH_PX), np.float32))
    coc_px = np.tile(np.linspace(-LARGEST_COC_PX, LARGEST_COC_PX, WIDTH_PX), (HEIGHT_PX, 1))
    kernel = Aperture.disc().rasterize(LARGEST_COC_PX).kernel.astype(np.float32)
    yardstick_ms = _milliseconds(lambda: cv2.filter2D(rgb, -1, kernel), repeats=5)
    print(f"{WIDTH_PX}x{HEIGHT_PX} px, circles of confusion up to {LARGEST_COC_PX:g} px; yardstick, OpenCV filter2D: {yardstick_ms:.1f} ms")
    for name, aperture in APERTURES.items():
        took_ms = _milliseconds(lambda chosen=aperture: blur_layer(layer, coc_px, chosen), repeats=2)
        print(f"scatter reference, {name}: {took_ms:.0f} ms, {took_ms / yardstick_ms:.0f} times the yardstick")
    print(memory_line())
    print(machine_line())


if __name__ == "__main__":
    main()
