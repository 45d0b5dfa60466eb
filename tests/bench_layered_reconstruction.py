"""How long layered reconstruction takes and how near it comes: `python -m tests.bench_layered_reconstruction [SIZE_PX]`.

The scene after Hasselgren 2015, Fig. 8 (an out-of-focus fence before a moving checkerboard and a slanted one) and a strongly slanted
plane, both met by rays in closed form; truth is 1024 samples a pixel. Yardsticks: the raw samples, and OpenCV's and
scikit-image's non-local means of them, each with the strength that suits the truth best (which nobody knows in earnest).
"""

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from statistics import median

import cv2
import numpy as np
from skimage.restoration import denoise_nl_means

from mrbokeh.image_metrics import psnr
from mrbokeh.light_field_samples import LightFieldSamples
from mrbokeh.renderers.layered_reconstruction import LayeredReconstruction, Settings
from tests.machine import machine_line, memory_line
from tests.sampled_planes import LENS, Plane, checker, fence_scene, sample_planes, truth, waves

SIZE_PX = 256
REPEATS = 5
ALL = Settings()
VARIANTS = {
    "all improvements": ALL,
    "neither merging nor sparse statistics": replace(ALL, merge=False, sparse_statistics=False),
    "merging alone": replace(ALL, sparse_statistics=False),
    "sparse statistics alone": replace(ALL, merge=False),
    "every sample weighs (no evening out)": replace(ALL, enough=np.inf),
    "Gaussian, sheared recursive, 2 passes": replace(ALL, screen_filter="sheared"),
    "Gaussian, mip map, four taps": replace(ALL, screen_filter="texture"),
    "Gaussian, direct": replace(ALL, screen_filter="direct"),
    "the paper: sheared, 1 pass, every sample weighs": replace(ALL, screen_filter="sheared", recursive_passes=1, enough=np.inf),
    "the paper without its improvements": replace(
        ALL, screen_filter="sheared", recursive_passes=1, enough=np.inf, merge=False, sparse_statistics=False
    ),
}


def scenes(size_px: int) -> dict[str, list[Plane]]:
    return {
        "fence": fence_scene(size_px),
        "slanted": [Plane(checker(16.0), 2.0, gradient=(0.15 * 128 / size_px, 0.05 * 128 / size_px))],
        "waves": [Plane(waves(20.0), 8.0, motion_px=(6.0, 2.0))],
    }


def _milliseconds(run: Callable[[], object]) -> tuple[float, float]:
    """Medians of the time that passes and of what all cores together spend, which other work on the machine disturbs less."""
    run()
    passed_s, spent_s = [], []
    for _ in range(REPEATS):
        started_s, spent_before_s = time.perf_counter(), time.process_time()
        run()
        passed_s.append(time.perf_counter() - started_s)
        spent_s.append(time.process_time() - spent_before_s)
    return 1e3 * median(passed_s), 1e3 * median(spent_s)


def _non_local_means_db(raw: np.ndarray, exact: np.ndarray) -> tuple[float, float]:
    """OpenCV's (on 8 bits) and scikit-image's, at their best strength."""
    coded = (np.clip(raw, 0, 1) * 255 + 0.5).astype(np.uint8)
    opencv = (cv2.fastNlMeansDenoisingColored(coded, None, h, h, 7, 21).astype(np.float32) / 255 for h in (5, 10, 15, 20, 30))
    scikit = (denoise_nl_means(raw, 5, 6, h=h, channel_axis=-1).astype(np.float32) for h in (0.03, 0.06, 0.09, 0.12, 0.18))
    return max(psnr(each, exact) for each in opencv), max(psnr(each, exact) for each in scikit)


def _one(name: str, samples: LightFieldSamples, exact: np.ndarray) -> None:
    raw = samples.raw_picture()
    opencv_db, scikit_db = _non_local_means_db(raw, exact)
    print(
        f"{name}, {samples.per_pixel:.0f} spp: raw {psnr(raw, exact):.1f} dB, "
        f"non-local means {opencv_db:.1f} (OpenCV), {scikit_db:.1f} (scikit-image)"
    )
    for variant, settings in VARIANTS.items():
        method = LayeredReconstruction(settings)
        rgb, counts = method.reconstruct_counted(samples, LENS)
        passed_ms, spent_ms = _milliseconds(lambda chosen=method: chosen.reconstruct_counted(samples, LENS))
        print(
            f"  {variant}: {psnr(rgb, exact):.1f} dB, {passed_ms:.0f} ms ({spent_ms:.0f} ms of all cores), "
            f"partitions per tile {counts.before:.1f} -> {counts.after:.1f}"
        )


def main() -> None:
    size_px = int(sys.argv[1]) if len(sys.argv) > 1 else SIZE_PX
    print(f"{size_px} x {size_px} px, medians of {REPEATS}")
    for name, planes in scenes(size_px).items():
        exact = truth(planes, size_px)
        for per_pixel in (4, 8):
            _one(name, sample_planes(planes, size_px, per_pixel), exact)
    print(memory_line())
    print(machine_line())


if __name__ == "__main__":
    main()
