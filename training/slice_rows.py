"""Some rows of a slice with all that its stack knows of them; nothing else is decoded."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.images.camera_rgb import MASK_PREFIX, SATURATED, VALID
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.errors import InputError
from training.exr_rows import exr_size_px, read_rows

Mask = Bool[np.ndarray, "height width"]

REASONS = ("moving", "border", "board", "low_confidence")
"""Masks of the stack that are read; its "saturated" means saturated in any slice, and each slice has a mask of its own."""


@dataclass(frozen=True)
class StackRows:
    """What all slices of a stack share. rows: which of the picture. all_in_focus: (H, W, 3) linear Rec.709. confidence: of depth.
    exclusions: masks by reason."""

    rows: slice
    all_in_focus: Float32[np.ndarray, "height width 3"]
    depth_m: Float32[np.ndarray, "height width"]
    confidence: Float32[np.ndarray, "height width"]
    exclusions: dict[str, Mask]


@dataclass(frozen=True)
class SliceRows:
    """target: (H, W, 3) linear Rec.709."""

    shared: StackRows
    target: Float32[np.ndarray, "height width 3"]
    saturated: Mask
    valid: Mask


def slice_size_px(stack: FocalStack, index: int) -> tuple[int, int]:
    """(height, width), from the header of its file."""
    return exr_size_px(stack.folder / stack.slices[index].path)


def read_stack_rows(stack: FocalStack, rows: slice) -> StackRows:
    """rows: a plain slice within the picture. Raises InputError where the stack is not merged and metric, or a file cannot be read."""
    if not (stack.merged and stack.is_metric):
        raise InputError(f"{stack.folder} has no all-in-focus picture with depth in metres: run `mrbokeh capture merge` on it")
    depth = read_rows(stack.depth_path, rows, ("Z", "confidence"))
    all_in_focus = stack.to_rec709(_stacked(read_rows(stack.all_in_focus_path, rows, "RGB")))
    return StackRows(rows, all_in_focus, depth["Z"], depth["confidence"], _exclusions(stack, rows))


def read_slice_rows(stack: FocalStack, index: int, rows: slice, shared: StackRows | None = None) -> SliceRows:
    """shared: these rows of the stack, where they have been read; raises as `read_stack_rows` does."""
    shared = read_stack_rows(stack, rows) if shared is None else shared
    photograph = read_rows(stack.folder / stack.slices[index].path, rows, "RGB", (SATURATED, VALID))
    saturated, valid = photograph.pop(SATURATED, None), photograph.pop(VALID, None)
    target = stack.to_rec709(_stacked(photograph))
    return SliceRows(
        shared,
        target,
        np.zeros(target.shape[:2], bool) if saturated is None else saturated > 0,
        np.ones(target.shape[:2], bool) if valid is None else valid > 0.5,
    )


def _exclusions(stack: FocalStack, rows: slice) -> dict[str, Mask]:
    if not stack.exclusion_path.is_file():
        return {}
    masks = read_rows(stack.exclusion_path, rows, optional=[MASK_PREFIX + reason for reason in REASONS])
    return {name.removeprefix(MASK_PREFIX): mask > 0.5 for name, mask in masks.items()}


def _stacked(channels: dict[str, Float32[np.ndarray, "height width"]]) -> Float32[np.ndarray, "height width 3"]:
    return np.stack([channels[name] for name in "RGB"], axis=-1)
