"""Measurements of the demo: merged stacks against the truth that they were made from, the network against its baselines."""

import csv
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import read_image, read_layer
from mrbokeh.images.image_metrics import psnr
from mrbokeh.optics.camera import Camera, camera_from_json
from mrbokeh.stacks.focal_stack import FocalStack, read_focal_stack
from mrbokeh.system.atomic_files import read_json

FIRST_PASS_FOLDER = "first_pass"

TRUSTED = 0.3
LEAST_ALL_IN_FOCUS_DB = 38.0
MOST_LOST_DB = 0.5
LARGEST_DEPTH_ERROR = 0.03
LARGEST_CAMERA_ERROR = 0.01
LEAST_GAIN_DB = 3.0
OPAQUE = 0.9
LARGEST_SIDESTEP = 0.02
"""Of the width of the picture."""


@dataclass(frozen=True)
class Truth:
    """Picture and depth that a pinhole in the middle of the lens sees. all_in_focus: linear Rec.709; depth_m: along the optical axis."""

    all_in_focus: Float32[np.ndarray, "height width 3"]
    depth_m: Float32[np.ndarray, "height width"]


def read_truth(folder: Path) -> Truth:
    depth_m = read_exr(folder / "depth.exr")[0].stacked(["Z"])[..., 0]
    return Truth(read_image(folder / "all_in_focus.exr"), depth_m)


def true_cameras(data: Path) -> tuple[Camera, ...]:
    """The reference camera of every view, translations in metres; data: a folder that datasets_scripts.make_raw_stack wrote."""
    document = read_json(data / "truth.json", "the truth of a RAW stack")
    return tuple(camera_from_json(view["reference_camera"]) for view in document["views"])


def has_second_pass(stack: FocalStack) -> bool:
    return (stack.folder / FIRST_PASS_FOLDER / stack.depth_path.name).is_file()


def first_pass(stack: FocalStack) -> FocalStack:
    """The stack with the all-in-focus picture and depth that it had before `mrbokeh capture depth`."""
    return replace(stack, folder=stack.folder / FIRST_PASS_FOLDER) if has_second_pass(stack) else stack


@dataclass(frozen=True)
class Measurement:
    """Number of the report: its subject, its text, the wanted value, and whether that is met."""

    what: str
    text: str
    wanted: str
    met: bool


def merge_measurements(stack_folder: Path, truth_folder: Path) -> list[Measurement]:
    """Measure all-in-focus picture (linear, clipped to 1) and trusted depth against the pinhole truth, also of the first pass."""
    stack, truth = read_focal_stack(stack_folder), read_truth(truth_folder)
    passes = [first_pass(stack), stack] if has_second_pass(stack) else [stack]
    decibels = [psnr(each.all_in_focus(), truth.all_in_focus) for each in passes]
    depths = [depth_error(each, truth) for each in passes]
    sharpest_db = max(psnr(rgb, truth.all_in_focus) for rgb in stack.iter_rgb())
    earlier_db = "".join(f", from focus alone {each:.2f} dB" for each in decibels[:-1])
    earlier = "".join(f"; from focus alone {each.median:.2%} in {each.trusted:.0%}" for each in depths[:-1])
    return [
        Measurement(
            f"{stack.folder.name}: all-in-focus picture (the best single slice has {sharpest_db:.1f} dB{earlier_db})",
            f"{decibels[-1]:.2f} dB",
            f"at least {LEAST_ALL_IN_FOCUS_DB:g} dB" + (f", {MOST_LOST_DB:g} dB below focus alone at most" if decibels[1:] else ""),
            decibels[-1] >= max(LEAST_ALL_IN_FOCUS_DB, decibels[0] - MOST_LOST_DB),
        ),
        Measurement(
            f"{stack.folder.name}: depth, median relative error where it is trusted ({depths[-1].trusted:.0%} of the picture{earlier})",
            f"{depths[-1].median:.2%}",
            f"below {LARGEST_DEPTH_ERROR:.0%}",
            depths[-1].median < LARGEST_DEPTH_ERROR,
        ),
    ]


@dataclass(frozen=True)
class DepthError:
    """Error of depth. median: relative, of trusted depth. trusted: share of the picture."""

    median: float
    trusted: float


def depth_error(stack: FocalStack, truth: Truth) -> DepthError:
    trusted = stack.depth_confidence() >= TRUSTED
    error = np.abs(stack.depth_m() / truth.depth_m - 1.0)
    return DepthError(float(np.median(error[trusted])), float(trusted.mean()))


def camera_measurements(stacks: Sequence[FocalStack], true: Sequence[Camera]) -> list[Measurement]:
    """Scale and focal length of cameras that `mrbokeh capture poses` and `scale` put into the stacks, against the true ones."""
    found = [stack.camera for stack in stacks if stack.camera is not None]
    if len(found) != len(true) or spread_m(found) == 0.0:
        return [Measurement("camera poses in metres", "not found", "found", False)]
    scale = spread_m(found) / spread_m(true) - 1.0
    focal = max((mine.focal_px[0] / other.focal_px[0] - 1.0 for mine, other in zip(found, true, strict=True)), key=abs)
    numbers = {f"distances between the {len(found)} cameras": scale, "focal length of the cameras": focal}
    return [
        Measurement(f"{what}, relative error", f"{error:+.2%}", f"within {LARGEST_CAMERA_ERROR:.0%}", abs(error) <= LARGEST_CAMERA_ERROR)
        for what, error in numbers.items()
    ]


def spread_m(cameras: Sequence[Camera]) -> float:
    """Root of the mean squared distance of the camera centres from their mean: what a similarity of least squares scales by."""
    centres_m = np.array([camera.world_from_camera[:3, 3] for camera in cameras])
    return float(np.sqrt(((centres_m - centres_m.mean(axis=0)) ** 2).sum(axis=1).mean()))


def placement_measurement(layer: Path, at_pixel: str) -> Measurement:
    """Measure whether a virtual object stands upright over its pixel; its shadow is no more than half opaque."""
    alpha = read_layer(layer).alpha
    solid = np.nonzero(alpha > OPAQUE)[1]
    off_px = abs(float(solid.mean()) + 0.5 - float(at_pixel.split(",")[0])) if len(solid) else float("inf")
    allowed_px = LARGEST_SIDESTEP * alpha.shape[1]
    return Measurement(f"{layer.stem}: object beside its pixel", f"{off_px:.1f} px", f"at most {allowed_px:.0f} px", off_px <= allowed_px)


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
