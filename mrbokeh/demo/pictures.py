"""Pictures of the stages for the report."""

from pathlib import Path

import numpy as np

from mrbokeh.atomic_files import atomic_path
from mrbokeh.focal_stack import read_focal_stack
from mrbokeh.image_io import write_preview


def stack_pictures(stack_folder: Path, out: Path) -> list[tuple[Path, str]]:
    """(file, caption) of the nearest, middle and farthest slice, the all-in-focus picture, and the depth."""
    stack = read_focal_stack(stack_folder)
    chosen = sorted({0, len(stack) // 2, len(stack) - 1})
    shown = []
    for index in chosen:
        path = out / f"{stack.folder.name}_slice_{index}.png"
        write_preview(path, stack.slice_rgb(index))
        shown.append((path, f"slice {index}, focused at {stack.slices[index].focus_distance_m:.3g} m"))
    merged = out / f"{stack.folder.name}_all_in_focus.png"
    write_preview(merged, stack.all_in_focus())
    depth = out / f"{stack.folder.name}_depth.png"
    write_depth_preview(depth, stack.depth_m(), stack.depth_confidence())
    return [*shown, (merged, "all in focus"), (depth, "depth: near is red, far is blue; grey where it is a guess")]


def write_depth_preview(path: Path, depth_m: np.ndarray, confidence: np.ndarray) -> None:
    """Dioptres in colours between their 1st and 99th percentile, fading to grey with the confidence."""
    import cv2

    dioptres = 1.0 / depth_m
    low, high = np.percentile(dioptres, [1, 99])
    level = np.clip((dioptres - low) / max(high - low, 1e-9), 0, 1)
    colours = cv2.applyColorMap(np.round(255 * level).astype(np.uint8), cv2.COLORMAP_TURBO).astype(np.float32)
    trust = np.clip(confidence[..., None] / 0.3, 0.25, 1.0)
    picture = np.round(trust * colours + (1 - trust) * 128).astype(np.uint8)
    data = cv2.imencode(path.suffix, picture)[1]
    with atomic_path(path) as temporary:
        data.tofile(temporary)
