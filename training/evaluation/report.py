"""Reports of an evaluation: a Markdown table, CSV, and sheets of pictures.

The sheets show whole slices, and crops where the network is worst and where the highlights are.
"""

import csv
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.image_io import SheetRow, write_contact_sheet
from mrbokeh.images.image_metrics import psnr
from mrbokeh.system.atomic_files import atomic_path
from training.evaluation.methods import NO_BLUR, Method
from training.evaluation.scores import NOT_MEASURED, Evaluation, Score
from training.evaluation.unseen_slice import UnseenSlice, highlight_discs

HEADINGS = ("method", "PSNR dB", "SSIM", "edge PSNR dB", "energy", "leak", "lights", "LPIPS", "flicker", "ms", "MiB")
_LEGEND = (
    "PSNR and SSIM of linear radiance clipped to [0, 1], over all pixels with a truth; edge PSNR within half of the largest circle of "
    "confusion of a depth edge. Energy: light over true light, unclipped. Leak: light that runs over the sharp side of depth edges, over "
    "the light there. Lights: absolute error over light, unclipped, in the discs of lights (0.5: half of the light is missing). Flicker: "
    "error of second differences in time, over 4, times 1000. ms: median of a picture. MiB: memory of a picture, weights apart."
)
MOST_ROWS = 12
CROP_PX = 96
CELL_PX = 192
Image = Float32[np.ndarray, "height width 3"]


def table_rows(result: Evaluation) -> list[tuple[str, ...]]:
    """Return one row of text per method under HEADINGS, best PSNR first."""
    return [_row(result, name) for name in sorted(result.methods, key=lambda name: result.mean(name, "psnr_db"), reverse=True)]


def _row(result: Evaluation, name: str) -> tuple[str, ...]:
    digits = {"psnr_db": 2, "ssim": 4, "edge_psnr_db": 2, "energy_ratio": 3, "leak": 4, "highlight_error": 3, "lpips": 4}
    means = [number(result.mean(name, measure), count) for measure, count in digits.items()]
    seconds = [each.seconds for each in result.scores if each.method == name]
    costs = (1e3 * result.flicker.get(name, float("nan")), 1e3 * float(np.median(seconds)), result.peak_memory_mib.get(name, float("nan")))
    return (name, *means, number(costs[0], 3), number(costs[1], 1), number(costs[2], 0))


def number(value: float, digits: int) -> str:
    return "-" if np.isnan(value) else f"{value:.{digits}f}"


def gain_lines(result: Evaluation) -> list[str]:
    """Return how far each network is above the sharp picture and above the better Gaussian, one sentence each."""
    if NO_BLUR not in result.methods or not result.rivals:
        return []
    return [
        f"{name} over no blur {result.gain_db(name, NO_BLUR):+.2f} dB, "
        f"over the better Gaussian {result.gain_db(name, result.better_gaussian):+.2f} dB"
        for name in result.networks
    ]


def write_table(path: Path, result: Evaluation, against: str, what: str) -> None:
    """Write the Markdown table. against: the truth of the focus pull, "" without one. what: names the slices."""
    lines = [
        f"Mean over {result.slices} {what}. {_LEGEND}",
        "",
        *markdown_table(HEADINGS, table_rows(result)),
        "",
        *(f"{line}.\n" for line in gain_lines(result)),
        *([f"Flicker is against {against}.\n"] if against else []),
        *([f"{NOT_MEASURED}\n"] if np.isnan(result.mean(result.methods[0], "lpips")) else []),
    ]
    with atomic_path(path) as temporary:
        temporary.write_text("\n".join(lines), encoding="utf-8")


def markdown_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (headings, ["---"] * len(headings), *rows)]


def write_numbers(path: Path, scores: Sequence[Score]) -> None:
    """Write the CSV: one line per method and slice."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        rows: Any = csv.DictWriter(file, [each.name for each in fields(Score)])
        rows.writeheader()
        rows.writerows(vars(each) for each in scores)


class Sheets:
    """Sheets with rows of at most MOST_ROWS slices, spread over all, and their crops; filled slice by slice to keep few pictures."""

    def __init__(self, methods: Sequence[Method], slices: int) -> None:
        self._kinds = {each.name: each.kind for each in methods}
        self._chosen = set(np.unique(np.linspace(0, slices - 1, min(MOST_ROWS, slices)).round().astype(int)).tolist())
        self._rows: list[SheetRow] = []
        self._crops: list[SheetRow] = []

    def note(self, index: int, seen: UnseenSlice, results: Mapping[str, Image]) -> None:
        if index not in self._chosen:
            return
        shown = self._shown(seen, results)
        self._rows.append(SheetRow(seen.label, shown))
        for what, window in informative_crops(seen, next(iter(results.values()))).items():
            self._crops.append(
                SheetRow(f"{seen.label}, {what}", {caption: enlarged(picture[window]) for caption, picture in shown.items()})
            )

    def write(self, out: Path) -> None:
        """Write evaluation.png and evaluation_crops.png."""
        write_contact_sheet(out / "evaluation.png", self._rows)
        write_contact_sheet(out / "evaluation_crops.png", self._crops)

    def _shown(self, seen: UnseenSlice, results: Mapping[str, Image]) -> dict[str, Image]:
        """Return input, truth, the networks, the best of every other kind, and the first network's errors."""
        shown = {"input": seen.pair.all_in_focus, "truth": seen.pair.target}
        networks = [name for name in results if self._kinds[name] == "network"]
        rivals = [self._best(seen, results, kind) for kind in ("Gaussian", "renderer")]
        for name in (*networks, *(each for each in rivals if each), *([NO_BLUR] if NO_BLUR in results else [])):
            shown[f"{name} {psnr(results[name], seen.pair.target, mask=seen.counted):.1f} dB"] = results[name]
        if networks:
            shown[f"{networks[0]} - truth, x4"] = _difference(results[networks[0]], seen.pair.target)
        return shown

    def _best(self, seen: UnseenSlice, results: Mapping[str, Image], kind: str) -> str | None:
        names = [name for name in results if self._kinds[name] == kind]
        return max(names, key=lambda name: psnr(results[name], seen.pair.target, mask=seen.counted), default=None)


def informative_crops(seen: UnseenSlice, result: Image) -> dict[str, tuple[slice, slice]]:
    """Return squares around the largest error of a result and, if there are any, around the brightest disc of a highlight."""
    error = (np.abs(np.clip(result, 0, 1) - np.clip(seen.pair.target, 0, 1)).sum(axis=2)) * seen.pair.weight
    windows = {"largest error": _window(error)}
    discs = highlight_discs(seen)
    return windows | ({"lights": _window(seen.pair.target.sum(axis=2) * discs)} if discs.any() else {})


def _window(interest: Float32[np.ndarray, "height width"]) -> tuple[slice, slice]:
    """Return the square with the largest sum of interest around it."""
    from scipy.ndimage import uniform_filter

    side = min(CROP_PX, *interest.shape)
    peak = np.unravel_index(int(uniform_filter(interest, max(1, side // 4)).argmax()), interest.shape)
    starts = [int(np.clip(at - side // 2, 0, length - side)) for at, length in zip(peak, interest.shape, strict=True)]
    return slice(starts[0], starts[0] + side), slice(starts[1], starts[1] + side)


def enlarged(crop: Image) -> Float32[np.ndarray, "enlarged_height enlarged_width 3"]:
    """Enlarge by whole pixels, so that they can be seen."""
    times = max(1, round(CELL_PX / crop.shape[1]))
    return crop.repeat(times, axis=0).repeat(times, axis=1)


def _difference(result: Image, truth: Image) -> Image:
    return (0.5 + 4.0 * (np.clip(result, 0, 1) - np.clip(truth, 0, 1))).astype(np.float32)
