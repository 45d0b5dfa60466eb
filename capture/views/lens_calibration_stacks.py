"""A lens calibration put to use on stacks without camera poses: their focus distances, and the depth from focus that rests on them."""

from pathlib import Path

import numpy as np

from capture.views.lens_calibration import LensCalibration, apply_lens_calibration, check_lens
from mrbokeh.exr_io import ExrPart, read_exr, write_exr
from mrbokeh.focal_stack import FocalStack, find_focal_stacks, write_focal_stack

_FARTHEST_DIOPTRE = 1e-6


def calibrate_scene(scene: Path, calibration: LensCalibration) -> list[FocalStack]:
    """Apply to every stack of a scene and write; all lenses are checked before anything is changed."""
    stacks = find_focal_stacks(scene)
    for stack in stacks:
        check_lens(stack, calibration)
    changed = [apply_lens_calibration(stack, calibration) for stack in stacks]
    for stack in changed:
        if stack.merged:
            write_depth(stack)
        write_focal_stack(stack)
    return changed


def write_depth(stack: FocalStack) -> None:
    """Depth in metres anew from the focus index, interpolated in dioptres."""
    parts = read_exr(stack.depth_path)
    channels = dict(parts[0].channels)
    if "focus_index" not in channels:
        return
    dioptres = np.array([1.0 / distance for distance in stack.focus_distances_m if distance is not None])
    interpolated = np.interp(channels["focus_index"], np.arange(len(stack)), dioptres)
    channels["Z"] = (1.0 / np.maximum(interpolated, _FARTHEST_DIOPTRE)).astype(np.float32)
    write_exr(stack.depth_path, ExrPart(channels))
