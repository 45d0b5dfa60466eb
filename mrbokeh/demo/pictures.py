"""Pictures of the demo's report that show a second pass: depth before and after, its confidence, how far it is off."""

from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Float32

from mrbokeh.demo.truth import Truth, first_pass, has_second_pass
from mrbokeh.figures.stack_pictures import depth_picture
from mrbokeh.images.color import srgb_to_linear
from mrbokeh.images.image_io import write_preview
from mrbokeh.stacks.focal_stack import FocalStack

Plane = Float[np.ndarray, "height width"]
Rgb = Float32[np.ndarray, "height width 3"]

WORST = 0.1
"""Relative error of depth that is drawn brightest."""


def write_depth_pictures(stack: FocalStack, truth: Truth, out: Path) -> list[tuple[Path, str]]:
    """(file, caption) of what `mrbokeh capture depth` changed; [] where there was no second pass."""
    if not has_second_pass(stack):
        return []
    passes = {"from focus alone": first_pass(stack), "from focus and all viewpoints": stack}
    pictures = {name: _views(each, name, truth) for name, each in passes.items()}
    written = []
    for kind in ("depth", "confidence", "error"):
        for number, name in enumerate(passes, 1):
            rgb, caption = pictures[name][kind]
            path = out / f"{stack.folder.name}_pass_{number}_{kind}.png"
            write_preview(path, rgb)
            written.append((path, caption))
    return written


def _views(stack: FocalStack, name: str, truth: Truth) -> dict[str, tuple[Rgb, str]]:
    """(picture, caption) of each kind."""
    error = np.abs(stack.depth_m() / truth.depth_m - 1.0)
    return {
        "depth": (depth_picture(stack), f"depth {name}; grey where it is a guess"),
        "confidence": (_grey(stack.depth_confidence()), f"confidence of the depth {name}: white is 1"),
        "error": (_colours(error / WORST), f"error of the depth {name}: black is none, bright yellow {WORST:.0%} or more"),
    }


def _grey(level: Plane) -> Rgb:
    return srgb_to_linear(np.repeat(np.clip(level, 0.0, 1.0)[..., None], 3, axis=2).astype(np.float32))


def _colours(level: Plane) -> Rgb:
    steps = np.round(255.0 * np.clip(level, 0.0, 1.0)).astype(np.uint8)
    return srgb_to_linear(cv2.applyColorMap(steps, cv2.COLORMAP_INFERNO)[..., ::-1] / np.float32(255.0))
