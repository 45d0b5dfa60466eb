"""What the demo measures: merged stacks against the truth they were made from, the network against its baselines."""

import csv
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mrbokeh.atomic_files import read_json
from mrbokeh.exr_io import read_exr
from mrbokeh.focal_stack import read_focal_stack
from mrbokeh.image_io import read_image
from mrbokeh.image_metrics import psnr

TEXTURED = 0.3
LEAST_ALL_IN_FOCUS_DB = 38.0
LARGEST_DEPTH_ERROR = 0.03
LEAST_GAIN_DB = 3.0


@dataclass(frozen=True)
class Measurement:
    """One number of the report: what it is, its text, what was wanted, and whether it is so."""

    what: str
    text: str
    wanted: str
    met: bool


def merge_measurements(stack_folder: Path, truth_folder: Path) -> list[Measurement]:
    """All-in-focus picture (linear, clipped to 1) and depth (where there is texture) against the pinhole truth."""
    stack = read_focal_stack(stack_folder)
    truth = read_image(truth_folder / "all_in_focus.exr")
    true_depth_m = read_exr(truth_folder / "depth.exr")[0].stacked(["Z"])[..., 0]
    merged_db = psnr(stack.all_in_focus(), truth)
    sharpest_db = max(psnr(rgb, truth) for rgb in stack.iter_rgb())
    textured = stack.depth_confidence() >= TEXTURED
    error = float(np.median(np.abs(stack.depth_m() / true_depth_m - 1.0)[textured]))
    name = stack.folder.name
    return [
        Measurement(
            f"{name}: all-in-focus picture (the best single slice has {sharpest_db:.1f} dB)",
            f"{merged_db:.2f} dB",
            f"at least {LEAST_ALL_IN_FOCUS_DB:g} dB",
            merged_db >= LEAST_ALL_IN_FOCUS_DB,
        ),
        Measurement(
            f"{name}: depth, median relative error where there is texture ({textured.mean():.0%} of the picture)",
            f"{error:.2%}",
            f"below {LARGEST_DEPTH_ERROR:.0%}",
            error < LARGEST_DEPTH_ERROR,
        ),
    ]


def parity_measurement(network: Path) -> Measurement:
    """ONNX Runtime against PyTorch, as `mrbokeh train export` measured it."""
    record = read_json(network.with_name(network.name + ".json"), "the record of an exported network")
    difference, allowed = float(record["parity_difference"]), float(record["largest_allowed"])
    what = f"{network.parent.name}: ONNX Runtime against PyTorch, largest difference of radiance"
    return Measurement(what, f"{difference:.1e}", f"below {allowed:.0e}", difference < allowed)


def network_measurements(evaluation_folder: Path) -> list[Measurement]:
    """The network on held-out slices against no blur and the better Gaussian, from evaluation.csv."""
    by_method: dict[str, list[float]] = defaultdict(list)
    with (evaluation_folder / "evaluation.csv").open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            by_method[row["method"]].append(float(row["psnr_db"]))
    mean = {method: float(np.mean(values)) for method, values in by_method.items()}
    rivals = {"no blur": mean["no blur"], "a Gaussian of the right size": max(mean["Gaussian, scattered"], mean["Gaussian, gathered"])}
    return [
        Measurement(
            f"network on {len(by_method['network'])} slices it has not seen ({mean['network']:.2f} dB) over {rival} ({decibel:.2f} dB)",
            f"{mean['network'] - decibel:+.2f} dB",
            f"at least +{LEAST_GAIN_DB:g} dB",
            mean["network"] - decibel >= LEAST_GAIN_DB,
        )
        for rival, decibel in rivals.items()
    ]
