"""Pictures of the report as JPEG in memory."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from capture.report.stack_view import StackView
from mrbokeh.figures.stack_pictures import depth_picture
from mrbokeh.images.color import display_rgb8
from mrbokeh.system.html_page import inline_figure

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]

WIDEST_PX = 480
_QUALITY = 82
_DIFFERENCE_GAIN = 5.0
_DEPTH_SPAN_PX = 3.0
_CROP_QUALITY = 95
_MOST_CONTRAST = 8.0
_MARK = (255, 0, 200)


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


def crops_shown(crops: Sequence[tuple[str, Rgb]], block: tuple[int, int, int], *, enhance: bool, overlay: bool) -> list[Shown]:
    """Crops at 100 %, each with its name; block: x, y and side of a square to be framed in all of them.

    enhance: raise the contrast of all alike, until what lies around the square in the first fills the range. overlay: add the last two
    crops in red and cyan.
    """
    levels = [display_rgb8(np.clip(rgb, 0.0, 1e4).astype(np.float32)).astype(np.float32) for _, rgb in crops]
    names, contrast = [name for name, _ in crops], 1.0
    if overlay:
        red, cyan = (each.mean(axis=2) for each in levels[-2:])
        levels.append(np.stack([red, cyan, cyan], axis=2))
        names.append(f"{names[-2]} in red, {names[-1]} in cyan")
    if enhance:
        x, y, side = block
        around = levels[0][max(y - side // 2, 0) : y + 3 * side // 2, max(x - side // 2, 0) : x + 3 * side // 2]
        middle = around.mean(axis=(0, 1))
        contrast = float(np.clip(110.0 / max(np.percentile(np.abs(around - middle), 99.0), 1e-3), 1.0, _MOST_CONTRAST))
        levels = [127.0 + contrast * (each - middle) for each in levels]
    suffix = f", contrast {contrast:.1f} times" if contrast > 1.0 else ""
    return [
        Shown(_framed_jpeg(np.clip(np.round(each), 0, 255).astype(np.uint8), block), name + suffix)
        for name, each in zip(names, levels, strict=True)
    ]


def _framed_jpeg(rgb8: np.ndarray, block: tuple[int, int, int]) -> bytes:
    """Without loss of colour, and with a frame that leaves the square itself free."""
    x, y, side = block
    framed = cv2.rectangle(np.ascontiguousarray(rgb8), (x - 1, y - 1), (x + side, y + side), _MARK, 1)
    return _jpeg(framed, _CROP_QUALITY)


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


def _jpeg(rgb8: np.ndarray, quality: int = _QUALITY) -> bytes:
    sampling = cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444 if quality > _QUALITY else cv2.IMWRITE_JPEG_SAMPLING_FACTOR_420
    options = [cv2.IMWRITE_JPEG_QUALITY, quality, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, sampling]
    return cv2.imencode(".jpg", np.ascontiguousarray(rgb8[..., ::-1]), options)[1].tobytes()
