"""An evaluation as a Markdown table and as CSV."""

import csv
from collections.abc import Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

from mrbokeh.system.atomic_files import atomic_path
from training.evaluation.methods import NO_BLUR
from training.evaluation.perceptual import NOT_MEASURED
from training.evaluation.scores import Evaluation, Score

HEADINGS = ("method", "PSNR dB", "SSIM", "edge PSNR dB", "energy", "leak", "lights", "LPIPS", "flicker", "ms", "MiB")
_LEGEND = (
    "PSNR and SSIM of linear radiance clipped to [0, 1], over all pixels with a truth; edge PSNR within half of the largest circle of "
    "confusion of a depth edge. Energy: light over true light, unclipped. Leak: light that runs over the sharp side of depth edges, over "
    "the light there. Lights: absolute error over light, unclipped, in the discs of lights (0.5: half of the light is missing). Flicker: "
    "error of second differences in time, over 4, times 1000. ms: median of a picture. MiB: memory of a picture, weights apart."
)


def table_rows(result: Evaluation) -> list[tuple[str, ...]]:
    """One row of text per method under HEADINGS, best PSNR first."""
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
    """How far each network is above the sharp picture and above the better Gaussian, one sentence each."""
    if NO_BLUR not in result.methods or not result.rivals:
        return []
    return [
        f"{name} over no blur {result.gain_db(name, NO_BLUR):+.2f} dB, "
        f"over the better Gaussian {result.gain_db(name, result.better_gaussian):+.2f} dB"
        for name in result.networks
    ]


def write_table(path: Path, result: Evaluation, against: str, what: str) -> None:
    """against: what the focus pull was compared with, "" where there was none. what: the slices are."""
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
    """One line per method and slice."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        rows: Any = csv.DictWriter(file, [each.name for each in fields(Score)])
        rows.writeheader()
        rows.writerows(vars(each) for each in scores)
