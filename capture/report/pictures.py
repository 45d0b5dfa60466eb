"""Pictures of the report as JPEG in memory."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from capture.report.stack_view import StackView
from mrbokeh.color import display_rgb8
from mrbokeh.html_page import inline_figure
from mrbokeh.stack_pictures import depth_picture

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]

WIDEST_PX = 480
_QUALITY = 82
_DIFFERENCE_GAIN = 5.0
_DEPTH_SPAN_PX = 3.0


@dataclass(frozen=True)
class Shown:
    """An encoded picture and what it shows."""

    jpeg: bytes
    caption: str

    def html(self) -> str:
        return inline_figure(self.jpeg, "jpeg", self.caption)


def shown(rgb: Rgb, caption: str) -> Shown:
    """rgb: linear; shrunk to 480 px in linear light."""
    height, width = rgb.shape[:2]
    if width > WIDEST_PX:
        rgb = cv2.resize(rgb, (WIDEST_PX, round(height * WIDEST_PX / width)), interpolation=cv2.INTER_AREA)
    return Shown(_jpeg(display_rgb8(np.clip(rgb, 0.0, 1e4).astype(np.float32))), caption)


def slice_triple(index: int, rgb: Rgb, prediction: Rgb) -> list[Shown]:
    """A slice, its prediction, and their difference."""
    difference = np.clip(0.2 + _DIFFERENCE_GAIN * (rgb - prediction), 0.0, 1.0).astype(np.float32)
    return [
        shown(rgb, f"slice {index}"),
        shown(prediction, f"slice {index}, re-blurred from the all-in-focus picture"),
        shown(difference, f"slice {index}: slice minus re-blurred, {_DIFFERENCE_GAIN:g} times, grey is no difference"),
    ]


def stack_maps(view: StackView, moving: Mask | None, depth_off_px: Plane | None) -> list[Shown]:
    """All in focus, depth, confidence; what moved and where slices contradict depth, if anybody knows."""
    pictures = [
        shown(view.all_in_focus, "all in focus"),
        shown(depth_picture(view.stack), "depth: near is red, far is blue, grey where it is a guess"),
        Shown(_coloured(view.confidence, cv2.COLORMAP_VIRIDIS), "confidence of depth: dark is none, yellow is full"),
    ]
    if moving is not None:
        tinted = np.where(moving[..., None], np.array([0.9, 0.05, 0.6]), 0.6 * view.all_in_focus).astype(np.float32)
        pictures.append(shown(tinted, f"what moved during the stack ({moving.mean():.2%})"))
    if depth_off_px is not None:
        level = 0.5 + depth_off_px / (2.0 * _DEPTH_SPAN_PX)
        caption = f"where slices contradict depth: red and blue are {_DEPTH_SPAN_PX:g} px of blur or more, green is none"
        pictures.append(Shown(_coloured(level.astype(np.float32), cv2.COLORMAP_JET), caption))
    return pictures


def _coloured(level: Plane, colours: int) -> bytes:
    height, width = level.shape
    small = cv2.resize(level, (WIDEST_PX, round(height * WIDEST_PX / width)), interpolation=cv2.INTER_AREA) if width > WIDEST_PX else level
    bgr = cv2.applyColorMap(np.round(255.0 * np.clip(small, 0.0, 1.0)).astype(np.uint8), colours)
    return _jpeg(bgr[..., ::-1])


def _jpeg(rgb8: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", np.ascontiguousarray(rgb8[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
