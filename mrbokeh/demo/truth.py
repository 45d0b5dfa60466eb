"""The truth that the demo's simulated photographs were made from, and the two passes over a stack that are held against it."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.exr_io import read_exr
from mrbokeh.images.image_io import read_image
from mrbokeh.optics.camera import Camera, camera_from_json
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.atomic_files import read_json

FIRST_PASS_FOLDER = "first_pass"


@dataclass(frozen=True)
class Truth:
    """What a pinhole in the middle of the lens sees. all_in_focus: linear Rec.709; depth_m: along the optical axis."""

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
