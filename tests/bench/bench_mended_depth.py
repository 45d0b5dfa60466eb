"""What depth with faults costs, and what mending it gives back: `python -m tests.bench.bench_mended_depth TRUTH MIXED`.

TRUTH: a set by `python -m datasets_scripts.render_truth TRUTH`, for `render`; MIXED: one by `python -m datasets_scripts.mixed_reality
MIXED`, for `between`. dB of the frame, linear light clipped to [0, 1], against exact depth: with the damaged depth as it is / mended. Lamps
of a pixel or few hang in the air of these scenes, and hardly any fault leaves their depth: "without lamps" gives it back to both, so that
the surfaces can be told from them. Then the time of a picture of a megapixel.
"""

import argparse
from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from scipy.ndimage import gaussian_filter, grey_dilation, grey_erosion

from mrbokeh.compositing.choose import insertion_of
from mrbokeh.depth.edge_votes import grown
from mrbokeh.depth.mended_depth import mended
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import opaque
from mrbokeh.layering.highlights import find_highlights
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from tests.bench.machine import in_turns, tell
from tests.support.fidelity_cases import truth_cases
from tests.support.mixed_reality_cases import traced_cases

Plane = np.ndarray
RENDERER = PolygonDifferences()
_SKY_M, _SOFT_PX = 100.0, 2.0


def soft_disparity(depth_m: Plane) -> Plane:
    dioptres = gaussian_filter(np.where(np.isfinite(depth_m), 1.0 / depth_m, 0.0), _SOFT_PX).astype(np.float32)
    return np.where(dioptres > 1e-6, 1.0 / np.maximum(dioptres, 1e-6), np.inf).astype(np.float32)


def soft_depth(depth_m: Plane) -> Plane:
    return gaussian_filter(np.where(np.isfinite(depth_m), depth_m, _SKY_M).astype(np.float32), _SOFT_PX)


def with_holes(depth_m: Plane) -> Plane:
    """Unknown: what a second camera does not see beside near things, and specks."""
    dioptres, hole = np.where(np.isfinite(depth_m), 1.0 / depth_m, 0.0), np.zeros(depth_m.shape, bool)
    for by_px in range(1, 5):
        hole |= np.roll(dioptres, by_px, axis=1) - dioptres > 0.1
    hole |= gaussian_filter(np.random.default_rng(0).standard_normal(depth_m.shape), 2.0) > 0.17
    return np.where(hole, np.float32(np.nan), depth_m)


DAMAGE: dict[str, Callable[[Plane], Plane]] = {
    "exact": lambda depth_m: depth_m,
    "soft disparity": soft_disparity,
    "soft depth": soft_depth,
    "too narrow": lambda depth_m: grey_dilation(depth_m, (3, 3)),
    "too wide": lambda depth_m: grey_erosion(depth_m, (3, 3)),
    "holes": with_holes,
}


def both_ways(depth_m: Plane, rgb: np.ndarray) -> tuple[Plane, Plane]:
    """Return damaged depth as a renderer takes it, holes at infinity, and mended."""
    return np.where(np.isnan(depth_m), np.float32(np.inf), depth_m), mended(depth_m, rgb).depth_m


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("truth", type=Path, nargs="?")
    parser.add_argument("mixed", type=Path, nargs="?")
    folders = parser.parse_args()
    if folders.mixed is None:
        print("not measured: it needs two folders of traced pictures, TRUTH and MIXED")
        return
    found: dict[tuple[str, str], list[tuple[float, float]]] = defaultdict(list)
    for case in truth_cases(folders.truth):
        rgb, exact_m = case.picture.rgb, case.picture.depth_m
        lamps = grown(find_highlights(rgb), 1)
        for kind, damage in DAMAGE.items():
            ways = both_ways(damage(exact_m), rgb)
            for group, planes in ((case.group, ways), (f"{case.group}, without lamps", [np.where(lamps, exact_m, each) for each in ways])):
                blurred = [RENDERER.render([opaque(rgb, each)], case.lens).rgb for each in planes]
                found[f"render, {group}", kind].append((psnr(blurred[0], case.truth), psnr(blurred[1], case.truth)))
    for mixed in traced_cases(folders.mixed):
        assert mixed.plate.depth_m is not None and mixed.plate.sharp_rgb is not None
        for kind, damage in DAMAGE.items():
            plates = [replace(mixed.plate, depth_m=each) for each in both_ways(damage(mixed.plate.depth_m), mixed.plate.sharp_rgb)]
            put_in = [insertion_of("between").insert(plate, [mixed.virtual], RENDERER).rgb for plate in plates]
            found["between", kind].append((psnr(put_in[0], mixed.truth), psnr(put_in[1], mixed.truth)))
    print_table({key: np.mean(values, axis=0) for key, values in found.items()})
    print_times(folders.truth)
    tell()


def print_table(means: dict[tuple[str, str], np.ndarray]) -> None:
    print(f"| | exact, dB | {' | '.join(list(DAMAGE)[1:])} |\n|---|---|{'---|' * (len(DAMAGE) - 1)}")
    for group in dict.fromkeys(group for group, _ in means):
        exact_db, mended_db = means[group, "exact"]
        cells = [f"{means[group, kind][0] - exact_db:+.1f} / {means[group, kind][1] - exact_db:+.1f}" for kind in list(DAMAGE)[1:]]
        print(f"| {group} | {exact_db:.1f} ({mended_db - exact_db:+.2f} mended) | {' | '.join(cells)} |")


def print_times(truth: Path) -> None:
    """Median seconds of a megapixel, made of copies of the first scene, after a first run that compiles."""
    case = next(iter(truth_cases(truth)))
    height, width = case.picture.depth_m.shape
    across, down = -(-1250 // width), -(-800 // height)
    rgb = np.tile(case.picture.rgb, (down, across, 1))[:800, :1250].copy()
    for kind, damage in DAMAGE.items():
        depth_m = damage(np.tile(case.picture.depth_m, (down, across))[:800, :1250])
        print(f"a megapixel, {kind}: {in_turns(partial(mended, depth_m, rgb), repeats=3)[0].wall_ms / 1e3:.2f} s")


if __name__ == "__main__":
    main()
