"""Pictures of a merged focal stack for people to look at."""

from pathlib import Path

import numpy as np
from jaxtyping import Float32

from mrbokeh.color import srgb_to_linear
from mrbokeh.contact_sheet import SheetRow, write_contact_sheet
from mrbokeh.focal_stack import FocalStack
from mrbokeh.image_io import write_preview

SHEET_NAME = "merge.png"
TRUSTED = 0.3

Plane = Float32[np.ndarray, "height width"]
Rgb = Float32[np.ndarray, "height width 3"]


def write_merge_sheet(stack: FocalStack) -> Path:
    """merge.png in the folder of the stack: some slices, the all-in-focus picture and the depth side by side."""
    captions = [f"slice {index}{_focus_text(stack, index)}" for index in shown_slices(stack)]
    slices = dict(zip(captions, (stack.slice_rgb(index) for index in shown_slices(stack)), strict=True))
    path = stack.folder / SHEET_NAME
    write_contact_sheet(path, [SheetRow(stack.folder.name, slices | {"all in focus": stack.all_in_focus(), "depth": depth_picture(stack)})])
    return path


def write_stack_pictures(stack: FocalStack, out: Path) -> list[tuple[Path, str]]:
    """(file, caption) of some slices, the all-in-focus picture and the depth, at full size."""
    pictures = [(stack.slice_rgb(index), f"slice {index}{_focus_text(stack, index)}", f"slice_{index}") for index in shown_slices(stack)]
    pictures.append((stack.all_in_focus(), "all in focus", "all_in_focus"))
    pictures.append((depth_picture(stack), "depth: near is red, far is blue; grey where it is a guess", "depth"))
    written = []
    for rgb, caption, name in pictures:
        path = out / f"{stack.folder.name}_{name}.png"
        write_preview(path, rgb)
        written.append((path, caption))
    return written


def shown_slices(stack: FocalStack) -> list[int]:
    """The nearest, a middle and the farthest slice."""
    return sorted({0, len(stack) // 2, len(stack) - 1})


def depth_picture(stack: FocalStack) -> Rgb:
    """Depth (dioptres, or the focus index) in colours between its 1st and 99th percentile, grey where it is a guess; scene-linear."""
    import cv2

    nearness: Plane = (1.0 / stack.depth_m() if stack.is_metric else -stack.focus_index()).astype(np.float32)
    low, high = np.percentile(nearness, [1, 99])
    level = np.clip((nearness - low) / max(high - low, 1e-9), 0, 1)
    colours = cv2.applyColorMap(np.round(255 * level).astype(np.uint8), cv2.COLORMAP_TURBO)[..., ::-1] / np.float32(255.0)
    trust = np.clip(stack.depth_confidence()[..., None] / TRUSTED, 0.25, 1.0)
    return 0.8 * srgb_to_linear(trust * colours + (1 - trust) * 0.5)


def _focus_text(stack: FocalStack, index: int) -> str:
    distance_m = stack.slices[index].focus_distance_m
    return "" if distance_m is None else f", focused at {distance_m:.3g} m"
