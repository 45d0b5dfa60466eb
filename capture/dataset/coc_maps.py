"""Signed circle of confusion of every slice: computed when asked for, written only where somebody wants files.

Depth and lens say it all, so that a data set carries no maps unless asked: 30 of 24 megapixels are 1.4 GB per stack. Half precision keeps
11 bits: at 100 px of blur a step is 0.06 px.
"""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.images.exr_io import ExrPart, write_exr
from mrbokeh.stacks.focal_stack import FocalStack

CHANNEL = "coc_px"
FOLDER = "coc"
_COMMENT = "signed diameter of the circle of confusion in pixels of the registered slice: + behind the focus, - in front"


def coc_maps(stack: FocalStack) -> Iterator[Float32[np.ndarray, "height width"]]:
    """(H, W) per slice, in order; one at a time."""
    depth_m = stack.depth_m()
    return (stack.coc_px(index, depth_m) for index in range(len(stack)))


def largest_coc_px(stack: FocalStack, counted: Bool[np.ndarray, "height width"]) -> float:
    """The largest diameter over all slices among counted pixels."""
    return max(float(np.abs(coc_px[counted]).max(initial=0.0)) for coc_px in coc_maps(stack))


def write_coc_maps(stack: FocalStack, folder: Path) -> list[Path]:
    """folder/00.exr and so on, half precision; existing ones are kept."""
    paths = [folder / f"{index:02d}.exr" for index in range(len(stack))]
    for path, coc_px in zip(paths, coc_maps(stack), strict=True):
        if not path.exists():
            write_exr(path, ExrPart({CHANNEL: coc_px.astype(np.float16)}, attributes={"comments": _COMMENT}))
    return paths
