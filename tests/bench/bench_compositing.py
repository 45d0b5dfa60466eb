"""How near each way of putting objects in comes to the truth, and how fast: `python -m tests.bench.bench_compositing [FOLDER] [--fast]`.

FOLDER: a set by `python -m datasets_scripts.mixed_reality FOLDER`; without one, cards of 320x214 px. PSNR in linear light clipped to
[0, 1]: of the frame, of the blurred region of object and occluders together, and of what the object touches. Yardsticks: the
blurred object cut by the sharp visibility mask, and the blurred object over everything. --rims: only between, of round openings, with
near things in depth so many pixels too wide, depth taken as it is and rims moved. Then times: a 24-megapixel photograph and
frames of 1080p, object and near things within a box of a tenth of the frame.
"""

import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from mrbokeh.compositing.choose import MODES, insertion_of
from mrbokeh.compositing.plate import Plate, plate_of
from mrbokeh.images.image_metrics import psnr
from mrbokeh.images.layer import Layer
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.polygon.polygon_differences import PolygonDifferences
from tests.bench.machine import in_turns, tell
from tests.support.mixed_reality_cases import BASELINES, MixedCase, card_cases, traced_cases

COLUMNS = (*BASELINES, *(mode for mode in MODES if mode != "front"))
RIMS_PX = (0, 1, 2, -1, -2)
REGIONS = ("frame", "object and occluders", "object")


def main() -> None:
    if "--rims" in sys.argv:
        print_rims(traced_cases(Path(sys.argv[1])))
        return
    folders = [Path(each) for each in sys.argv[1:] if not each.startswith("--")]
    print_table(traced_cases(folders[0]) if folders else card_cases(320, 214, ("disc", "blades7", "heart"), 400))
    if "--fast" not in sys.argv:
        for width, height, repeats in ((6000, 4000, 1), (1920, 1080, 3)):
            print_times(width, height, repeats)
    tell()


def print_table(cases: Iterator[MixedCase]) -> None:
    """One row of dB per picture and region; gain: of between over the better yardstick."""
    renderer, rows = PolygonDifferences(), []
    print(f"| picture | region | {' | '.join(COLUMNS)} | gain |\n|---|---|{'---|' * (len(COLUMNS) + 1)}")
    for case in cases:
        union, touched = case.union(renderer), case.touched(renderer)
        found = case.baselines(renderer) | {mode: MODES[mode].insert(case.plate, [case.virtual], renderer) for mode in COLUMNS[2:]}
        _require_untouched(case, found["between"].rgb, found["between"].virtual.alpha)
        values = np.array([case.measure(found[name], union, touched) for name in COLUMNS]).T
        rows.append(values)
        for region, each in zip(REGIONS, values, strict=True):
            print(_row(case.name, region, each))
    if not rows:
        raise SystemExit("no finished picture there: expected a folder by `python -m datasets_scripts.mixed_reality FOLDER`")
    for region, each in zip(REGIONS, np.mean(rows, axis=0), strict=True):
        print(_row("mean", region, each))
    gains = [(each[:, COLUMNS.index("between")] - each[:, :2].max(axis=1))[0] for each in rows]
    print(
        f"least gain over the better yardstick (frame): {min(gains):.1f} dB; untouched pixels are the plate's in all {len(rows)} pictures"
    )


def print_rims(cases: Iterator[MixedCase]) -> None:
    """Frame PSNR per picture: as it is, and with rims moved."""
    renderer, found = PolygonDifferences(), []
    print(f"| picture | {' | '.join(f'{by_px:+d} px' for by_px in RIMS_PX)} |\n|---|{'---|' * len(RIMS_PX)}")
    for case in cases:
        if ", disc, " not in case.name:
            continue
        ways = [insertion_of("between", exact_depth=exact) for exact in (True, False)]
        plates = [case.with_near_wider_by(by_px).plate for by_px in RIMS_PX]
        found.append([[psnr(way.insert(plate, [case.virtual], renderer).rgb, case.truth) for way in ways] for plate in plates])
        print(_pairs(case.name, np.array(found[-1])))
    print(_pairs("mean", np.mean(found, axis=0)))


def _pairs(name: str, values: np.ndarray) -> str:
    return f"| {name} | {' | '.join(f'{kept:.1f} / {moved:.1f}' for kept, moved in values)} |"


def print_times(width: int, height: int, repeats: int) -> None:
    """Median of each mode, after a first run that compiles and fills tables."""
    plate, virtual, renderer = *_large(width, height), PolygonDifferences()
    for mode in MODES:
        passed_s = in_turns(partial(MODES[mode].insert, plate, [virtual], renderer), repeats=repeats)[0].wall_ms / 1e3
        print(f"{width}x{height}, {mode}: {passed_s:.2f} s, {1.0 / passed_s:.1f} a second")


def _row(name: str, region: str, values: np.ndarray) -> str:
    gain = values[COLUMNS.index("between")] - values[:2].max()
    return f"| {name} | {region} | {' | '.join(f'{each:.1f}' for each in values)} | {gain:.1f} |"


def _require_untouched(case: MixedCase, rgb: np.ndarray, alpha: np.ndarray) -> None:
    untouched = alpha == 0
    if not np.array_equal(rgb[untouched], case.plate.rgb[untouched]):
        raise SystemExit(f"{case.name}: pixels that no virtual light reaches have changed")


def _large(width: int, height: int) -> tuple[Plate, Layer]:
    """Slats before a textured wall and a ball-sized object between them, a third of the frame wide and high."""
    rng = np.random.default_rng(0)
    tile = rng.uniform(0.05, 0.9, (64, 64, 3)).astype(np.float32)
    sharp = np.tile(tile, (-(-height // 64), -(-width // 64), 1))[:height, :width].copy()
    depth_m = np.full((height, width), 4.0, np.float32)
    slats = (np.arange(width) // (width // 60)) % 6 == 0
    depth_m[:, slats], sharp[:, slats] = 0.9, 0.15
    y, x = np.mgrid[:height, :width]
    inside = np.hypot(x - width / 2, y - height / 2) < height / 6
    alpha = inside.astype(np.float32)
    virtual = Layer(alpha[..., None] * tile[y % 64, x % 64], alpha, np.where(inside, 1.5, np.inf).astype(np.float32))
    return replace(plate_of(sharp, Lens(50.0, 4.0, 2.0, 36.0), depth_m), sharp_rgb=sharp), virtual


if __name__ == "__main__":
    main()
