"""Pixels that training should leave out: exclusion.exr of a stack, each reason a mask of its own; and what moved between slices.

A slice that disagrees with its prediction otherwise than its neighbours do shows movement. A wrong depth, a ghost or hidden background
leave a residual that changes slowly from slice to slice, for blur does. What moves leaves one that jumps between two slices. So a jump
counts if it exceeds what noise explains, what other slices show at the same pixel, what a diameter that is a little off would do there,
and a share of the radiance.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float16, Float32

from mrbokeh.images.camera_rgb import write_masks
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.atomic_files import read_json
from mrbokeh.system.errors import InputError

FEWEST_SLICES = 4
_SOFTENED_PX = 1.5
_NOISES = 6.0
_OTHERS = 4.0
_BLUR_PX = 1.0
_SHARE = 0.04
_DARK = 0.02
_LEAST_AREA = 2e-4
_LEAST_AREA_PX = 12
_GROWN_PX = 2
_BINS = 8
# The kernel of Immerkaer, Fast noise variance estimation (1996): blind to planes; its response to white noise of 1 is 6.
_NOISE_KERNEL = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]], np.float32)
_NOISE_RESPONSE = 6.0
REASONS = ("moving", "saturated", "border", "low_confidence", "board")
SCALE_FILE = "reconstruction/scale.json"
LEAST_CONFIDENCE = 0.1

Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class Disagreement:
    """Disagreement of a slice and its prediction, in luminance and half precision, for all slices are held at once.

    residual: slice minus prediction. level: of the prediction. per_px: how the prediction changes for each pixel of diameter.
    counted: pixels to judge by.
    """

    residual: Float16[np.ndarray, "height width"]
    level: Float16[np.ndarray, "height width"]
    per_px: Float16[np.ndarray, "height width"]
    counted: Mask


def exclusion_masks(stack: FocalStack, moving: Bool[np.ndarray, "rows columns"] | None) -> dict[str, Mask]:
    """Return masks by reason, at the size of the stack. Slices are read one at a time.

    moving: at any size, None where nobody looked. saturated: in any slice. border: no data in some slice. board: where
    `mrbokeh capture scale` found a calibration board, as SCENE/reconstruction/scale.json says.
    """
    low_confidence = stack.depth_confidence() < LEAST_CONFIDENCE
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
    """Return whether exclusion.exr is there and no older than what it was made from."""
    made_from = [path for path in (stack.all_in_focus_path, stack.depth_path, stack.folder.parent / SCALE_FILE) if path.is_file()]
    path = stack.exclusion_path
    return path.is_file() and all(path.stat().st_mtime_ns >= each.stat().st_mtime_ns for each in made_from)


def board_mask(stack: FocalStack, shape: tuple[int, ...]) -> Mask:
    """Return pixels of the calibration board and up to one around it; none where no board was found (see `capture.scale.answer`)."""
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


def moving(slices: Sequence[Disagreement], depth_off_px: Plane) -> Mask | None:
    """Return (H, W) where something moved during the stack; None where fewer than FEWEST_SLICES slices cannot tell.

    depth_off_px: by how much diameters are known to be wrong (see `slice_fit`).
    """
    if len(slices) < FEWEST_SLICES:
        return None
    blur_px = _BLUR_PX + np.abs(depth_off_px)
    jumps, allowed = zip(*(_jump(*pair, blur_px) for pair in pairwise(map(_Graded.of, slices))), strict=True)
    sizes = np.stack(jumps)
    # A third and not the median: something that comes and goes again jumps twice.
    usual = np.quantile(sizes, 1.0 / 3.0, axis=0).astype(np.float32)
    jumped = np.zeros(usual.shape, bool)
    for size, limit in zip(sizes, allowed, strict=True):
        jumped |= size > limit + _OTHERS * usual
    return _areas(jumped)


@dataclass(frozen=True)
class _Graded:
    """Slice in single precision, with the deviation of its noise."""

    residual: Plane
    level: Plane
    per_px: Plane
    noise: Plane
    counted: Mask

    @classmethod
    def of(cls, found: Disagreement) -> "_Graded":
        residual, level, per_px = (each.astype(np.float32) for each in (found.residual, found.level, found.per_px))
        return cls(residual=residual, level=level, per_px=per_px, noise=noise_deviation(residual, level), counted=found.counted)


def _jump(first: _Graded, second: _Graded, blur_px: Plane) -> tuple[Plane, Plane]:
    """Return how far the residual jumps between two slices, and what noise, a diameter off by blur_px and radiance allow."""
    both = (first.counted & second.counted).astype(np.float32)
    weight = np.maximum(_softened(both), 1e-3)
    size = np.abs(_softened((second.residual - first.residual) * both)) / weight * (weight > 0.5)
    noise = np.hypot(first.noise, second.noise)
    left = 1.0 / (2.0 * np.sqrt(np.pi) * _SOFTENED_PX)
    blur = _softened(np.maximum(np.abs(first.per_px), np.abs(second.per_px))) * blur_px
    radiance = _SHARE * (np.maximum(np.minimum(first.level, second.level), 0.0) + _DARK)
    return size.astype(np.float32), (_NOISES * left * noise + blur + radiance).astype(np.float32)


def noise_deviation(residual: Plane, level: Plane) -> Plane:
    """Return (H, W) the standard deviation of the noise as a function of radiance, measured in the fine grain of the residual."""
    grain = np.abs(cv2.filter2D(residual, -1, _NOISE_KERNEL)) / _NOISE_RESPONSE
    edges = np.quantile(level, np.linspace(0.0, 1.0, _BINS + 1))
    middles, deviations = [], []
    for low, high in pairwise(edges):
        within = (level >= low) & (level <= high)
        if within.any():
            middles.append(float(np.median(level[within])))
            deviations.append(1.4826 * float(np.median(grain[within])))
    return np.interp(level, middles, deviations).astype(np.float32)


def _softened(plane: Plane) -> Plane:
    return cv2.GaussianBlur(plane, (0, 0), _SOFTENED_PX)


def _areas(jumped: Mask) -> Mask:
    """Return connected areas that are not specks, grown a little."""
    _, labels, statistics, _ = cv2.connectedComponentsWithStats(jumped.astype(np.uint8), connectivity=8)
    large = statistics[:, cv2.CC_STAT_AREA] >= max(_LEAST_AREA_PX, _LEAST_AREA * jumped.size)
    large[0] = False
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _GROWN_PX + 1, 2 * _GROWN_PX + 1))
    return cv2.dilate(large[labels].astype(np.uint8), kernel) > 0
