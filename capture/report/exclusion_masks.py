"""exclusion.exr of a stack: pixels that training should leave out, each reason a mask of its own."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool

from mrbokeh.images.camera_rgb import write_masks
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError

Mask = Bool[np.ndarray, "height width"]

REASONS = ("moving", "saturated", "border", "low_confidence", "board")
SCALE_FILE = "reconstruction/scale.json"
LEAST_CONFIDENCE = 0.1


def exclusion_masks(
    stack: FocalStack, moving: Bool[np.ndarray, "rows columns"] | None, least_confidence: float = LEAST_CONFIDENCE
) -> dict[str, Mask]:
    """Masks by reason, at the size of the stack. Slices are read one at a time.

    moving: at any size, None where nobody looked. saturated: in any slice. border: no data in some slice. board: where
    `mrbokeh capture scale` found a calibration board, as SCENE/reconstruction/scale.json says.
    """
    low_confidence = stack.depth_confidence() < least_confidence
    saturated, border = np.zeros_like(low_confidence), np.zeros_like(low_confidence)
    for index in range(len(stack)):
        masks = stack.slice_masks(index)
        saturated |= masks.saturated
        border |= ~masks.valid
    enlarged = np.zeros_like(low_confidence) if moving is None else _enlarged(moving, low_confidence.shape)
    return dict(zip(REASONS, (enlarged, saturated, border, low_confidence, board_mask(stack, low_confidence.shape)), strict=True))


def write_exclusions(stack: FocalStack, masks: dict[str, Mask]) -> Path:
    write_masks(stack.exclusion_path, masks)
    return stack.exclusion_path


def has_fresh_exclusions(stack: FocalStack) -> bool:
    """Whether exclusion.exr is there and no older than what it was made from."""
    made_from = [path for path in (stack.all_in_focus_path, stack.depth_path, stack.folder.parent / SCALE_FILE) if path.is_file()]
    path = stack.exclusion_path
    return path.is_file() and all(path.stat().st_mtime_ns >= each.stat().st_mtime_ns for each in made_from)


def board_mask(stack: FocalStack, shape: tuple[int, ...]) -> Mask:
    """Pixels of the calibration board and up to one around it; none where no board was found (see `capture.scale.scale_file`)."""
    mask = np.zeros(shape, np.uint8)
    path = stack.folder.parent / SCALE_FILE
    if not path.is_file():
        return mask > 0
    try:
        answers = read_json(path, "the metric scale")["answers"]
        outlines = [each.get("outlines_px", {}).get(stack.folder.name, []) for each in answers if each["method"] == "board"]
        corners = np.asarray(outlines, np.float64).reshape(-1, 2)
    except (KeyError, AttributeError, ValueError, TypeError):
        raise InputError(
            f"{path}: expected the outline of the board in each view as x, y pairs: run `mrbokeh capture scale --overwrite`"
        ) from None
    if len(corners) >= 3:
        # OpenCV's pixel (0, 0) has its centre at (0, 0).
        cv2.fillPoly(mask, [np.round(corners - 0.5).astype(np.int32)], 1)
    return mask > 0


def _enlarged(mask: Mask, shape: tuple[int, ...]) -> Bool[np.ndarray, "rows columns"]:
    return cv2.resize(mask.astype(np.uint8), shape[1::-1], interpolation=cv2.INTER_NEAREST) > 0
