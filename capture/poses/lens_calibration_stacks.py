"""A lens calibration put to use on stacks without camera poses: their focus distances, and the depth from focus that rests on them."""

from pathlib import Path

from capture.merging.changed_metres import with_known_nearest, write_changed_metres
from capture.merging.replaced_places import depth_m_of
from capture.poses.lens_calibration import LensCalibration, apply_lens_calibration, check_lens
from mrbokeh.stacks.focal_stack import FocalStack, find_focal_stacks, write_focal_stack
from mrbokeh.stacks.guessed_metres import is_near_first


def calibrate_scene(scene: Path, calibration: LensCalibration) -> list[FocalStack]:
    """Apply to every stack of a scene and write; all lenses are checked before anything is changed."""
    stacks = find_focal_stacks(scene)
    for stack in stacks:
        check_lens(stack, calibration)
    changed = [apply_lens_calibration(stack, calibration) for stack in stacks]
    for before, after in zip(stacks, changed, strict=True):
        if after.merged:
            write_calibrated(before, after)
        else:
            write_focal_stack(after)
    return changed


def write_calibrated(before: FocalStack, after: FocalStack) -> None:
    """Write a merged stack with other focus distances, and its depth in metres anew from the focus index."""
    depth_m, turned = depth_m_of(after, after.focus_index()), is_near_first(before) != is_near_first(after)
    assert depth_m is not None, f"{after.folder}: calibrated stacks are metric"
    write_changed_metres(with_known_nearest(after, turned), depth_m, turned)
