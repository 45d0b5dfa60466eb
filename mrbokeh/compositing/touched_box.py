"""Where virtual light can arrive: any insertion computed in that box alone, so that a small object in a large photograph is quick."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.base import Inserted, Insertion, same_size
from mrbokeh.compositing.virtual_surface import shows
from mrbokeh.layer import Layer, clear, flatten
from mrbokeh.lens import Lens
from mrbokeh.motion import farthest_px
from mrbokeh.plate import Plate
from mrbokeh.renderers.base import Renderer
from mrbokeh.spreading import reach_px

_SPARE_PX = 4


@dataclass(frozen=True)
class Box:
    """Rows top to bottom and columns left to right of a picture; it may go beyond the frame."""

    top: int
    bottom: int
    left: int
    right: int

    def cut(self, plane: np.ndarray, mode: str, value: float = 0.0) -> np.ndarray:
        """The box of an array (H, W, ...); beyond the frame its border goes on (mode edge) or it is `value` (mode constant)."""
        height, width = plane.shape[:2]
        inside = plane[max(self.top, 0) : min(self.bottom, height), max(self.left, 0) : min(self.right, width)]
        beyond = (max(-self.top, 0), max(self.bottom - height, 0)), (max(-self.left, 0), max(self.right - width, 0))
        if not any(map(any, beyond)):
            return np.ascontiguousarray(inside)
        rest = ((0, 0),) * (plane.ndim - 2)
        return np.pad(inside, beyond + rest, mode="edge") if mode == "edge" else np.pad(inside, beyond + rest, constant_values=value)

    def paste(self, part: np.ndarray, whole: np.ndarray) -> None:
        """What of the box lies in the frame goes back to its place."""
        height, width = whole.shape[:2]
        top, bottom, left, right = max(self.top, 0), min(self.bottom, height), max(self.left, 0), min(self.right, width)
        whole[top:bottom, left:right] = part[top - self.top : bottom - self.top, left - self.left : right - self.left]


@dataclass(frozen=True)
class InTouchedBox:
    """An Insertion that lets another one work where light of the layers can arrive, and leaves the rest of the plate as it is.

    The result is that of the whole frame, but that near things which the frame cuts off go on beyond it. Where the blur depends on
    the place in the frame (tilt, cat-eyes, banks of kernels, networks) the whole frame is taken.
    """

    insertion: Insertion

    def insert(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        same_size(plate, layers)
        box = touched_box(plate, layers)
        if box is None:
            return Inserted(plate.rgb, flatten(layers) if layers else clear(*plate.rgb.shape[:2]))
        if not (_same_everywhere(plate.lens) and _blurs_by_aperture(renderer)) or (plate.depth_m is None and plate.near_alpha is not None):
            return self.insertion.insert(plate, layers, renderer)
        found = self.insertion.insert(_cut_plate(plate, box), [_cut_layer(layer, box) for layer in layers], renderer)
        return _pasted(found, plate, layers, box)


def touched_box(plate: Plate, layers: Sequence[Layer]) -> Box | None:
    """The box of all pixels that virtual light can reach, grown to all whose light mixes with it there; None where there is none."""
    reached = [_reached(layer, plate.lens) for layer in layers if shows(layer).any()]
    if not reached:
        return None
    arrival = _union(reached)
    if plate.depth_m is None:
        height, width = plate.rgb.shape[:2]
        return Box(max(arrival.top, 0), min(arrival.bottom, height), max(arrival.left, 0), min(arrival.right, width))
    return _with_sources(arrival, plate.depth_m, plate.lens)


def _reached(layer: Layer, lens: Lens) -> Box:
    there = shows(layer)
    rows, columns = np.flatnonzero(there.any(axis=1)), np.flatnonzero(there.any(axis=0))
    part = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    depth_m = layer.depth_m if not lens.has_flat_focus else layer.depth_m[part]
    coc_px = np.abs(np.asarray(lens.coc_px(depth_m, layer.width_px)))
    seen = there if not lens.has_flat_focus else there[part]
    reach = reach_px(lens.aperture, float(coc_px[seen].max())) + farthest_px([layer]) + _SPARE_PX
    return Box(int(rows[0]) - reach, int(rows[-1]) + 1 + reach, int(columns[0]) - reach, int(columns[-1]) + 1 + reach)


def _union(boxes: Sequence[Box]) -> Box:
    return Box(min(b.top for b in boxes), max(b.bottom for b in boxes), min(b.left for b in boxes), max(b.right for b in boxes))


def _with_sources(arrival: Box, depth_m: Float32[np.ndarray, "height width"], lens: Lens) -> Box:
    """Grown to every photographed pixel whose own blur reaches into the box; beyond the frame as far as those reach."""
    height, width = depth_m.shape
    half_px = 0.5 * lens.aperture.unit_radius * np.abs(np.asarray(lens.coc_px(depth_m, width), np.float32)) + np.float32(_SPARE_PX)
    rows, columns = np.arange(height), np.arange(width)
    down = np.maximum(np.maximum(arrival.top - rows, rows - arrival.bottom + 1), 0).astype(np.float32)
    along = np.maximum(np.maximum(arrival.left - columns, columns - arrival.right + 1), 0).astype(np.float32)
    sends = (half_px >= down[:, None]) & (half_px >= along[None, :])
    reach = int(np.ceil(half_px.max(initial=0.0, where=sends)))
    y, x = np.flatnonzero(sends.any(axis=1)), np.flatnonzero(sends.any(axis=0))
    if len(y) == 0:
        return arrival
    top, bottom = (min(arrival.top, int(y[0])), max(arrival.bottom, int(y[-1]) + 1))
    left, right = (min(arrival.left, int(x[0])), max(arrival.right, int(x[-1]) + 1))
    beyond = Box(arrival.top - reach, arrival.bottom + reach, arrival.left - reach, arrival.right + reach)
    return Box(
        beyond.top if beyond.top < 0 else top,
        beyond.bottom if beyond.bottom > height else bottom,
        beyond.left if beyond.left < 0 else left,
        beyond.right if beyond.right > width else right,
    )


def _same_everywhere(lens: Lens) -> bool:
    return lens.has_flat_focus and not lens.aperture.varies_over_field


def _blurs_by_aperture(renderer: Renderer) -> bool:
    """Whether its kernels are those of the lens's opening: banks and networks may know the place in the frame."""
    return hasattr(renderer, "layering") and getattr(renderer, "bank", None) is None


def _cut_plate(plate: Plate, box: Box) -> Plate:
    width_px, height_px = box.right - box.left, box.bottom - box.top
    principal = (plate.camera.principal_px[0] - box.left, plate.camera.principal_px[1] - box.top)
    camera = replace(plate.camera, width_px=width_px, height_px=height_px, principal_px=principal)
    lens = replace(plate.lens, sensor_width_mm=plate.lens.sensor_width_mm * width_px / plate.rgb.shape[1])
    known = {"depth_m": plate.depth_m, "sharp_rgb": plate.sharp_rgb, "near_alpha": plate.near_alpha}
    cut = {name: box.cut(plane, "edge") for name, plane in known.items() if plane is not None}
    rgb = box.cut(plate.rgb, "edge")
    return Plate(rgb, cut.get("depth_m"), lens, camera, cut.get("sharp_rgb"), cut.get("near_alpha"))


def _cut_layer(layer: Layer, box: Box) -> Layer:
    extra = {name: box.cut(values, "constant") for name, values in layer.extra.items()}
    depth_m = box.cut(layer.depth_m, "constant", np.inf)
    return Layer(box.cut(layer.rgb, "constant"), box.cut(layer.alpha, "constant"), depth_m, extra)


def _pasted(found: Inserted, plate: Plate, layers: Sequence[Layer], box: Box) -> Inserted:
    (height, width), virtual = plate.rgb.shape[:2], found.virtual
    photo_rgb, depth_m = plate.rgb.copy(), layers[-1].depth_m.copy()
    rgb, alpha = np.zeros((height, width, 3), np.float32), np.zeros((height, width), np.float32)
    extra = {name: np.zeros((height, width, values.shape[2]), np.float32) for name, values in virtual.extra.items()}
    parts = [(found.photo_rgb, photo_rgb), (virtual.depth_m, depth_m), (virtual.rgb, rgb), (virtual.alpha, alpha)]
    for part, whole in [*parts, *((values, extra[name]) for name, values in virtual.extra.items())]:
        box.paste(part, whole)
    return Inserted(photo_rgb, Layer(rgb, alpha, depth_m, extra))
