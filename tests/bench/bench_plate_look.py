"""What finishing costs: `python -m tests.bench.bench_plate_look`.

A 1080p frame with an object of 600x600 px, blurred at its edge. The yardstick is what composites usually do: normal noise drawn anew for
the object's box and filtered by OpenCV, without regard to level, coverage or channels.
"""

import time
from collections.abc import Callable

import cv2
import numpy as np

from mrbokeh.compositing.over import behind
from mrbokeh.compositing.plate import Inserted, plate_of
from mrbokeh.compositing.plate_look.colour_match import ColourMatch
from mrbokeh.compositing.plate_look.finishing import Finishing, LightWrap, finished
from mrbokeh.compositing.plate_look.grain import measured_grain, measured_grain_of_pair
from mrbokeh.compositing.plate_look.vignetting import RadialFalloff
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from tests.bench.machine import machine_line, memory_line

HEIGHT_PX, WIDTH_PX, OBJECT_PX = 1080, 1920, 600


def _milliseconds(run: Callable[[], object], repeats: int) -> float:
    run()
    started_s = time.perf_counter()
    for _ in range(repeats):
        run()
    return 1e3 * (time.perf_counter() - started_s) / repeats


def _plate(seed: int) -> np.ndarray:
    scene = np.linspace(0.05, 0.6, WIDTH_PX)[None, :, None] * np.ones((HEIGHT_PX, 1, 3))
    noise = cv2.GaussianBlur(np.random.default_rng(seed).standard_normal(scene.shape, np.float32), (0, 0), 0.6)
    return (scene + 0.02 * np.sqrt(scene) * noise).astype(np.float32)


def _object() -> Layer:
    y, x = np.mgrid[:HEIGHT_PX, :WIDTH_PX] + 0.5
    distance_px = np.hypot(y - 540, x - 900)
    alpha = np.clip((OBJECT_PX / 2 - distance_px) / 40.0, 0.0, 1.0).astype(np.float32)
    return Layer(alpha[..., None] * np.float32([0.4, 0.2, 0.1]), alpha, np.where(alpha > 0, 2.0, np.inf).astype(np.float32))


def _yardstick() -> np.ndarray:
    noise = np.random.default_rng(0).standard_normal((OBJECT_PX, OBJECT_PX, 3), np.float32)
    return cv2.GaussianBlur(noise, (7, 7), 0.8) * np.float32(0.01)


def main() -> None:
    plate, layer = plate_of(_plate(1), Lens(50.0, 2.0, 1.0, 36.0)), _object()
    inserted = Inserted(behind(plate.rgb, layer), layer)
    second = _plate(2)
    print(f"{WIDTH_PX}x{HEIGHT_PX} px, measuring grain once:")
    print(f"  in one frame {_milliseconds(lambda: measured_grain(plate.rgb), 2):.0f} ms, ", end="")
    print(f"in two {_milliseconds(lambda: measured_grain_of_pair(plate.rgb, second), 2):.0f} ms")
    grain = measured_grain(plate.rgb)
    print(f"  its texture {_milliseconds(lambda: measured_grain(plate.rgb).texture, 2):.0f} ms (with measuring)")
    yardstick_ms = _milliseconds(_yardstick, 10)
    print(f"per frame with an object of {OBJECT_PX} px; yardstick, noise drawn and filtered by OpenCV: {yardstick_ms:.1f} ms")
    colour, falloff, wrap = ColourMatch((1.1, 1.0, 0.9), (0.01, 0.01, 0.01)), RadialFalloff(-0.4), LightWrap(0.5, 8.0)
    for name, steps in {
        "grain": Finishing(grain=grain),
        "colour": Finishing(colour),
        "vignetting": Finishing(vignetting=falloff),
        "light wrap": Finishing(light_wrap=wrap),
        "colour, vignetting and grain": Finishing(colour, falloff, grain),
        "all": Finishing(colour, falloff, grain, wrap),
    }.items():
        took_ms = _milliseconds(lambda steps=steps: finished(inserted, plate, steps, 3), 10)
        print(f"  {name}: {took_ms:.1f} ms, {took_ms / yardstick_ms:.2f} times the yardstick")
    print(memory_line())
    print(machine_line())


if __name__ == "__main__":
    main()
