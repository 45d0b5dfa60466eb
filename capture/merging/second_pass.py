"""The second pass over a merged stack: its all-in-focus picture made anew with a depth that does not come from focus."""

import shutil
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32

from capture.merging.guided_all_in_focus import all_in_focus_from_depth
from capture.merging.restored_lights import restored_lights, with_restored_lights
from capture.merging.slice_optics import SliceOptics
from mrbokeh.images.camera_rgb import read_camera_rgb
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.atomic_files import atomic_path
from mrbokeh.system.errors import InputError

FIRST_PASS_FOLDER = "first_pass"
DEPTH_SOURCE = "depth_source"
"""Key in a stack's metadata: where depth.exr and all_in_focus.exr come from; FROM_FOCUS after merging."""
FROM_FOCUS = "focus"

Rgb = Float32[np.ndarray, "height width 3"]


def second_pass(stack: FocalStack, depth_m: Float[np.ndarray, "height width"], optics: SliceOptics | None = None) -> Rgb:
    """The all-in-focus picture of a merged stack in its camera RGB, guided by depth along the axis (metres, inf allowed).

    optics: focus and blur of each slice where they were calibrated; None takes what the stack states, which must be metric.
    """
    if not stack.merged:
        raise InputError(f"{stack.folder} is not merged yet: run `mrbokeh capture merge` before its depth is found")
    first = read_camera_rgb(first_pass_path(stack, stack.all_in_focus_path))
    optics = SliceOptics.of_stack(stack, first.shape[1]) if optics is None else optics

    def valid(index: int) -> Bool[np.ndarray, "height width"]:
        return stack.slice_masks(index).valid

    guided = all_in_focus_from_depth(stack.iter_camera_rgb, depth_m, optics, first, valid)
    return with_restored_lights(guided, restored_lights(stack.iter_camera_rgb, guided, guided=True)[1])


def keep_first_pass(stack: FocalStack) -> None:
    """Put all_in_focus.exr and depth.exr of the first pass into first_pass/, before a second pass writes its own."""
    for path in (stack.all_in_focus_path, stack.depth_path):
        kept = stack.folder / FIRST_PASS_FOLDER / path.name
        if not kept.is_file() and path.is_file():
            with atomic_path(kept) as temporary:
                shutil.copyfile(path, temporary)


def first_pass_path(stack: FocalStack, path: Path) -> Path:
    """Where the first pass's version of a picture lies, whether or not a second pass was made."""
    kept = stack.folder / FIRST_PASS_FOLDER / path.name
    return kept if kept.is_file() else path
