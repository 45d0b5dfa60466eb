"""Metres of a merged stack that are other than merging left them: depth.exr, stack.json and the pictures of them follow."""

from dataclasses import replace
from typing import Any

import numpy as np
from jaxtyping import Float32

from capture.merging.merged_pictures import write_depth_picture
from capture.merging.preferred_merge import PREFERRED
from mrbokeh.figures.stack_pictures import write_merge_sheet
from mrbokeh.images.exr_io import read_exr, write_exr
from mrbokeh.stacks.focal_stack import FocalStack, Slice, write_focal_stack
from mrbokeh.stacks.guessed_metres import POSITION, SLICE_POSITION


def with_known_nearest(stack: FocalStack, turned: bool) -> FocalStack:
    """Return the stack with what was recorded of near and far put right. turned: what was taken for near is far."""
    metadata = dict(stack.metadata)
    if PREFERRED in metadata:
        metadata[PREFERRED] = _known_side(metadata[PREFERRED], turned)
    return replace(stack, slices=tuple(map(_turned_slice, stack.slices)) if turned else stack.slices, metadata=metadata)


def _known_side(record: dict[str, Any], turned: bool) -> dict[str, Any]:
    if turned:
        other = "far" if record["side"] == "near" else "near"
        record = record | {"side": other, "first_is_near": not record["first_is_near"]}
    return record | {"sure": True}


def _turned_slice(each: Slice) -> Slice:
    if SLICE_POSITION not in each.metadata:
        return each
    return replace(each, metadata=each.metadata | {SLICE_POSITION: -each.metadata[SLICE_POSITION]})


def write_changed_metres(stack: FocalStack, depth_m: Float32[np.ndarray, "height width"], turned: bool) -> None:
    """Write the stack and its new depth, and the pictures that show them. turned: what was taken for near is far."""
    part = read_exr(stack.depth_path)[0]
    channels = dict(part.channels) | {"Z": depth_m}
    if turned and POSITION in channels:
        channels[POSITION] = -channels[POSITION]
    write_exr(stack.depth_path, replace(part, channels=channels), compress=False)
    write_focal_stack(stack)
    write_depth_picture(stack)
    write_merge_sheet(stack)
