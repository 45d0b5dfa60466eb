"""How long layered reconstruction takes and how near it comes: `python -m tests.bench.bench_layered_reconstruction [SIZE_PX | FOLDER]`.

The scene after Hasselgren 2015, Fig. 8 (an out-of-focus fence before a moving checkerboard and a slanted one) and a strongly slanted
plane, both met by rays in closed form; truth is 1024 samples a pixel. Yardsticks: the raw samples, and OpenCV's and
scikit-image's non-local means of them, each with the strength that suits the truth best (which nobody knows in earnest).
FOLDER: sets of samples as in tests/data/samples, met against their references instead, in linear light and as displayed
(sRGB), both clipped to [0, 1], in which papers count.
"""

import sys
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from skimage.restoration import denoise_nl_means

from mrbokeh.images.color import linear_to_srgb, srgb_to_linear
from mrbokeh.images.image_io import read_image
from mrbokeh.images.image_metrics import psnr, ssim
from mrbokeh.layering.light_field_samples import LightFieldSamples, read_samples
from mrbokeh.optics.lens_file import read_lens
from mrbokeh.renderers.layered_reconstruction import LayeredReconstruction, Settings
from tests.bench.machine import in_turns, tell
from tests.support.sampled_planes import LENS, Plane, checker, fence_scene, sample_planes, truth, waves

SIZE_PX = 256
REPEATS = 5
ALL = Settings()
VARIANTS = {
    "all improvements": ALL,
    "pupil and shutter in one part": replace(ALL, pupil_parts=1, shutter_parts=1),
    "pupil and shutter in 2 parts along each axis": replace(ALL, pupil_parts=2, shutter_parts=2),
    "one cell of motion": replace(ALL, motion_step_px=np.inf),
    "neither merging nor sparse statistics": replace(ALL, merge=False, sparse_statistics=False),
    "merging alone": replace(ALL, sparse_statistics=False),
    "parts are not merged": replace(ALL, part_tolerance=0.0),
    "buckets alone, as in the paper, are merged": replace(ALL, part_tolerance=0.0, faint=0.0),
    "one part without merging and sparse statistics": replace(ALL, pupil_parts=1, shutter_parts=1, merge=False, sparse_statistics=False),
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

OF_SETS = (
    "all improvements",
    "neither merging nor sparse statistics",
    "parts are not merged",
    "buckets alone, as in the paper, are merged",
    "pupil and shutter in one part",
    "one part without merging and sparse statistics",
)


def scenes(size_px: int) -> dict[str, list[Plane]]:
    return {
        "fence": fence_scene(size_px),
        "slanted": [Plane(checker(16.0), 2.0, gradient=(0.15 * 128 / size_px, 0.05 * 128 / size_px))],
        "waves": [Plane(waves(20.0), 8.0, motion_px=(6.0, 2.0))],
    }


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
        rgb, counts = method.reconstruct_values(samples, samples.rgb, LENS)
        passed_ms, spent_ms = in_turns(partial(method.reconstruct_values, samples, samples.rgb, LENS), repeats=REPEATS)[0]
        print(
            f"  {variant}: {psnr(rgb, exact):.1f} dB, {passed_ms:.0f} ms ({spent_ms:.0f} ms of all cores), "
            f"partitions per tile {counts.before:.1f} -> {counts.after:.1f}"
        )


def _means_of_displayed(raw: np.ndarray) -> list[np.ndarray]:
    """Non-local means of a displayed picture at several strengths, OpenCV's and then scikit-image's."""
    coded = (raw * 255 + 0.5).astype(np.uint8)
    opencv = [cv2.fastNlMeansDenoisingColored(coded, None, h, h, 7, 21).astype(np.float32) / 255 for h in (10, 20, 30, 45)]
    return opencv + [denoise_nl_means(raw, 5, 6, h=h, channel_axis=-1).astype(np.float32) for h in (0.06, 0.12, 0.18, 0.27)]


def _set(folder: Path) -> None:
    samples, lens = read_samples(folder / "samples.npz"), read_lens(folder / "lens.json")
    exact = read_image(folder / "reference.exr")[..., :3]
    shown, raw = linear_to_srgb(np.clip(exact, 0, 1)), linear_to_srgb(np.clip(samples.raw_picture(), 0, 1))
    means = _means_of_displayed(raw)
    linear_db = psnr(srgb_to_linear(raw), exact), max(psnr(srgb_to_linear(each), exact) for each in means)
    shown_db = psnr(raw, shown), max(psnr(each, shown) for each in means)
    print(
        f"{folder.name}, {samples.per_pixel:.0f} spp (dB linear / displayed): raw {linear_db[0]:.1f} / {shown_db[0]:.1f}, "
        f"best non-local means {linear_db[1]:.1f} / {shown_db[1]:.1f}"
    )
    for variant in OF_SETS:
        method = LayeredReconstruction(VARIANTS[variant])
        rgb, counts = method.reconstruct_values(samples, samples.rgb, lens)
        displayed = linear_to_srgb(np.clip(rgb, 0, 1))
        passed_ms, spent_ms = in_turns(partial(method.reconstruct_values, samples, samples.rgb, lens), repeats=REPEATS)[0]
        print(
            f"  {variant}: {psnr(rgb, exact):.1f} / {psnr(displayed, shown):.1f} dB, SSIM {ssim(displayed, shown):.3f}, {passed_ms:.0f} ms "
            f"({spent_ms:.0f} ms of all cores), partitions per tile {counts.before:.1f} -> {counts.after:.1f}"
        )


def main() -> None:
    if len(sys.argv) > 1 and not sys.argv[1].isdigit():
        for folder in sorted(path.parent for path in Path(sys.argv[1]).glob("*/samples.npz")):
            _set(folder)
    else:
        _planes(int(sys.argv[1]) if len(sys.argv) > 1 else SIZE_PX)
    tell()


def _planes(size_px: int) -> None:
    print(f"{size_px} x {size_px} px, medians of {REPEATS}")
    for name, planes in scenes(size_px).items():
        exact = truth(planes, size_px)
        for per_pixel in (4, 8):
            _one(name, sample_planes(planes, size_px, per_pixel), exact)


if __name__ == "__main__":
    main()
