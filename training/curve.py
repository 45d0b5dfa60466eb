"""How a run came along: a table and a picture of it, in the folder of the run."""

import csv
import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from mrbokeh.system.atomic_files import atomic_path

TABLE_NAME = "curve.csv"
PICTURE_NAME = "curve.png"


class CurvePoint(NamedTuple):
    """loss: smoothed, of training; held_out_psnr_db: nan between the looks at held-out slices; learning_rate: of the step before."""

    step: int
    elapsed_s: float
    loss: float
    held_out_psnr_db: float
    learning_rate: float


def write_curve(folder: Path, curve: Sequence[CurvePoint]) -> None:
    """curve.csv; the PSNR is empty where nobody looked."""
    with atomic_path(folder / TABLE_NAME) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(CurvePoint._fields)
        rows.writerows(["" if isinstance(value, float) and math.isnan(value) else value for value in point] for point in curve)


def draw_curve(folder: Path, curve: Sequence[CurvePoint]) -> None:
    """curve.png: loss and learning rate (both logarithmic) and the PSNR on held-out slices, over steps."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.0, 6.5), layout="constrained")
    loss, psnr, rate = figure.subplots(3, 1, sharex=True, height_ratios=(3, 3, 1))
    steps = [point.step for point in curve]
    loss.semilogy(steps, [point.loss for point in curve], color="tab:blue")
    looks = [point for point in curve if not math.isnan(point.held_out_psnr_db)]
    psnr.plot([point.step for point in looks], [point.held_out_psnr_db for point in looks], "o-", markersize=3, color="tab:green")
    rate.semilogy(steps, [point.learning_rate for point in curve], color="tab:gray")
    for axes, label in ((loss, "training loss"), (psnr, "held-out PSNR (dB)"), (rate, "learning rate")):
        axes.set_ylabel(label)
        axes.grid(alpha=0.3)
    rate.set_xlabel("step")
    with atomic_path(folder / PICTURE_NAME) as temporary:
        figure.savefig(temporary, dpi=100)
