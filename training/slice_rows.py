"""Some rows of a slice with all that its stack knows of them; nothing else is decoded."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.camera_rgb import MASK_PREFIX, SATURATED, VALID
from mrbokeh.errors import InputError
from mrbokeh.focal_stack import FocalStack
from training.exr_rows import exr_size_px, read_rows

Mask = Bool[np.ndarray, "height width"]

REASONS = ("moving", "border", "board", "low_confidence")
"""Masks of the stack that are read; its "saturated" means saturated in any slice, and each slice has a mask of its own."""


@dataclass(frozen=True)
class SliceRows:
    """rows: which of the picture. all_in_focus, target: (H, W, 3) linear Rec.709. confidence: of depth. exclusions: masks by reason."""

    rows: slice
    all_in_focus: Float32[np.ndarray, "height width 3"]
    target: Float32[np.ndarray, "height width 3"]
    depth_m: Float32[np.ndarray, "height width"]
    confidence: Float32[np.ndarray, "height width"]
    saturated: Mask
    valid: Mask
    exclusions: dict[str, Mask] = field(default_factory=dict)


def slice_size_px(stack: FocalStack, index: int) -> tuple[int, int]:
    """(height, width), from the header of its file."""
    return exr_size_px(stack.folder / stack.slices[index].path)


def read_slice_rows(stack: FocalStack, index: int, rows: slice) -> SliceRows:
    """rows: a plain slice within the picture. Raises InputError where the stack is not merged and metric, or a file cannot be read."""
    if not (stack.merged and stack.is_metric):
        raise InputError(f"{stack.folder} has no all-in-focus picture with depth in metres: run `mrbokeh capture merge` on it")
    photograph = read_rows(stack.folder / stack.slices[index].path, rows, "RGB", (SATURATED, VALID))
    saturated, valid = photograph.pop(SATURATED, None), photograph.pop(VALID, None)
    target = stack.to_rec709(_stacked(photograph))
    depth = read_rows(stack.depth_path, rows, ("Z", "confidence"))
    return SliceRows(
        rows,
        stack.to_rec709(_stacked(read_rows(stack.all_in_focus_path, rows, "RGB"))),
        target,
        depth["Z"],
        depth["confidence"],
        np.zeros(target.shape[:2], bool) if saturated is None else saturated > 0,
        np.ones(target.shape[:2], bool) if valid is None else valid > 0.5,
        _exclusions(stack, rows),
    )


def _exclusions(stack: FocalStack, rows: slice) -> dict[str, Mask]:
    if not stack.exclusion_path.is_file():
        return {}
    masks = read_rows(stack.exclusion_path, rows, optional=[MASK_PREFIX + reason for reason in REASONS])
    return {name.removeprefix(MASK_PREFIX): mask > 0.5 for name, mask in masks.items()}


def _stacked(channels: dict[str, Float32[np.ndarray, "height width"]]) -> Float32[np.ndarray, "height width 3"]:
    return np.stack([channels[name] for name in "RGB"], axis=-1)
