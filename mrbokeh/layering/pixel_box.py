"""Box: an upright rectangle of pixels, cut out of pictures and layers and pasted back, and the camera and lens that see it alone."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from mrbokeh.images.layer import Layer, clear
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens


@dataclass(frozen=True)
class Box:
    """Rows top to bottom and columns left to right, ends excluded; it may go beyond the frame."""

    top: int
    bottom: int
    left: int
    right: int

    @property
    def is_empty(self) -> bool:
        return self.bottom <= self.top or self.right <= self.left

    @property
    def size_px(self) -> tuple[int, int]:
        """Height and width."""
        return self.bottom - self.top, self.right - self.left

    @property
    def origin_px(self) -> tuple[int, int]:
        """Row and column of its first pixel."""
        return self.top, self.left

    @property
    def where(self) -> tuple[slice, slice]:
        """Index of its pixels, for a box within the frame."""
        return slice(self.top, self.bottom), slice(self.left, self.right)

    def grown(self, margin_px: int) -> "Box":
        """Return the box, larger by so many pixels on all sides, also beyond the frame."""
        return Box(self.top - margin_px, self.bottom + margin_px, self.left - margin_px, self.right + margin_px)

    def within(self, frame_px: tuple[int, ...]) -> "Box":
        """Return the part of the box in a frame of (height, width)."""
        height, width = frame_px[:2]
        return Box(max(self.top, 0), min(self.bottom, height), max(self.left, 0), min(self.right, width))

    def of(self, picture: np.ndarray) -> Any:
        """Return a view of the pixels (H, W, ...) of a box within the frame."""
        return picture[self.where]

    def cut(self, plane: np.ndarray, mode: str, value: float = 0.0) -> np.ndarray:
        """Return the box of an array (H, W, ...); beyond the frame its border goes on (mode edge) or it is `value` (mode constant)."""
        inside = self.within(plane.shape)
        part = inside.of(plane)
        beyond = (inside.top - self.top, self.bottom - inside.bottom), (inside.left - self.left, self.right - inside.right)
        if not any(map(any, beyond)):
            return np.ascontiguousarray(part)
        rest = ((0, 0),) * (plane.ndim - 2)
        return np.pad(part, beyond + rest, mode="edge") if mode == "edge" else np.pad(part, beyond + rest, constant_values=value)

    def paste(self, part: np.ndarray, whole: np.ndarray) -> None:
        """Put the part of the box that lies in the frame back to its place."""
        inside = self.within(whole.shape)
        rows = slice(inside.top - self.top, inside.bottom - self.top)
        inside.of(whole)[...] = part[rows, inside.left - self.left : inside.right - self.left]

    def cut_layer(self, layer: Layer) -> Layer:
        """Return the layer's part in the box, clear beyond the frame."""
        extra = {name: self.cut(values, "constant") for name, values in layer.extra.items()}
        depth_m = self.cut(layer.depth_m, "constant", np.inf)
        return Layer(self.cut(layer.rgb, "constant"), self.cut(layer.alpha, "constant"), depth_m, extra)

    def placed(self, part: Layer, frame_px: tuple[int, ...]) -> Layer:
        """Return a layer of the box's size in a clear one of (height, width)."""
        height, width = frame_px[:2]
        extra = {name: np.zeros((height, width, values.shape[2]), np.float32) for name, values in part.extra.items()}
        whole = replace(clear(height, width), extra=extra)
        pairs = [(part.rgb, whole.rgb), (part.alpha, whole.alpha), (part.depth_m, whole.depth_m)]
        for values, target in [*pairs, *((values, extra[name]) for name, values in part.extra.items())]:
            self.paste(values, target)
        return whole

    def camera_of(self, camera: Camera) -> Camera:
        """Return the camera that sees just this part."""
        principal = (camera.principal_px[0] - self.left, camera.principal_px[1] - self.top)
        return replace(camera, width_px=self.right - self.left, height_px=self.bottom - self.top, principal_px=principal)

    def lens_of(self, lens: Lens, frame_width_px: int) -> Lens:
        """Return the lens with so much of its sensor as sees this part, so that circles of confusion keep their size."""
        return replace(lens, sensor_width_mm=lens.sensor_width_mm * (self.right - self.left) / frame_width_px)


NOWHERE = Box(0, 0, 0, 0)


def lit_box(layer: Layer) -> Box:
    """Return the smallest box with all pixels that cover or hold any light; NOWHERE where there are none."""
    from mrbokeh.layering._pixels_numba import widen

    box = np.array([layer.height_px, 0, layer.width_px, 0])
    for values in (layer.alpha[..., None], layer.rgb, *layer.extra.values()):
        if values.shape[2]:
            widen(box, np.ascontiguousarray(values).reshape(layer.height_px, -1), values.shape[2])
    return Box(*box.tolist()) if box[1] > 0 else NOWHERE


def is_same_everywhere(lens: Lens) -> bool:
    """Return whether a point's blur depends on its depth alone, so that a part of the picture can be blurred by itself."""
    return lens.has_flat_focus and not lens.aperture.varies_over_field
