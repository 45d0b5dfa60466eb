"""A stack with dense depth on disk: the picture made with it, depth and what they came from."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, Float32

from capture.dense.finish import DenseDepth
from capture.merging.merged_pictures import write_readable_pictures
from capture.merging.preferred_merge import PREFERRED
from capture.merging.retouch import RETOUCHES
from capture.merging.second_pass import DEPTH_SOURCE, first_pass_path, second_pass
from mrbokeh.figures.stack_pictures import write_merge_sheet
from mrbokeh.images.camera_rgb import read_camera_rgb
from mrbokeh.images.exr_io import read_exr
from mrbokeh.stacks.focal_stack import FocalStack, write_focal_stack, write_merged

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

# Between these confidences the second pass takes over from the first; seams are as soft as this.
_DOUBTED, _TRUSTED = 0.3, 0.6
_SEAM_PX = 1.5


def write_deepened(stack: FocalStack, found: DenseDepth, record: dict[str, object]) -> FocalStack:
    """Pictures first, stack.json last; retouches and the preferred side are of the first picture. record: what the depth was made from."""
    kept = {key: value for key, value in stack.metadata.items() if key not in (RETOUCHES, PREFERRED)}
    deepened = replace(stack, metadata=kept | {DEPTH_SOURCE: record})
    write_merged(
        stack.folder,
        _picture(deepened, found),
        _focus_index(stack, found.depth_m),
        found.confidence,
        found.depth_m,
        stack.rec709_from_camera,
    )
    write_readable_pictures(deepened)
    write_focal_stack(deepened)
    write_merge_sheet(deepened)
    return deepened


def _picture(stack: FocalStack, found: DenseDepth) -> Rgb:
    """The second pass where its depth can be trusted, else the first: a wrong depth takes pixels from slices in which they are blurred.

    On traced stacks the mixture is 0 to 2 dB above the second pass and 0.1 to 0.9 dB above the first.
    """
    first = read_camera_rgb(first_pass_path(stack, stack.all_in_focus_path))
    if not stack.is_metric:
        return first
    trusted = np.clip((found.confidence - _DOUBTED) / (_TRUSTED - _DOUBTED), 0.0, 1.0)
    share = cv2.GaussianBlur(trusted.astype(np.float32), (0, 0), _SEAM_PX)[..., None]
    return share * second_pass(stack, found.depth_m) + (1.0 - share) * first


def _focus_index(stack: FocalStack, depth_m: Float[np.ndarray, "height width"]) -> Plane:
    """The fractional index of the slice that is focused at each depth; the first pass's where focus distances are unknown."""
    if not stack.is_metric:
        return read_exr(first_pass_path(stack, stack.depth_path))[0].channels["focus_index"].astype(np.float32)
    dioptres = np.array([1.0 / distance for distance in stack.focus_distances_m if distance is not None])
    order = np.argsort(dioptres)
    return np.interp(1.0 / depth_m, dioptres[order], np.arange(len(dioptres))[order].astype(np.float64)).astype(np.float32)
