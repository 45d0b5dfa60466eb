"""Insertion frame after frame: only the box that virtual light can reach, and what did not change since the last frame is kept.

The simple modes (front, over) blur the layers alone, so their blur is the same in every frame in which neither the layers nor the
focus nor the depth of the photograph change. Other modes look at the picture itself and are done anew, in boxes of their own
(mrbokeh.compositing.touched_box).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.base import Inserted, Insertion, same_size
from mrbokeh.compositing.occlusion import covered_by, occlusion_matte
from mrbokeh.compositing.over import OverPhotograph, behind
from mrbokeh.compositing.plate import Plate, plate_of
from mrbokeh.compositing.touched_box import InTouchedBox, touched_box
from mrbokeh.images.alpha_io import coverage_with
from mrbokeh.images.layer import Layer, clear, flatten
from mrbokeh.layering.pixel_box import NOWHERE, Box, is_same_everywhere
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.shots.kept import Kept

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]


@dataclass(frozen=True)
class Part:
    """What is put into one part of a frame; box None is the whole."""

    box: Box | None
    inserted: Inserted

    def over(self, rgb: Rgb) -> Rgb:
        """The frame with it; other pixels stay bit for bit."""
        if self.box is None:
            return self.inserted.rgb
        result = rgb.copy()
        self.box.paste(self.inserted.rgb, result)
        return result

    def covered(self, alpha: Plane) -> Plane:
        """The frame's own alpha with it; other pixels stay bit for bit."""
        if self.box is None:
            return coverage_with(alpha, self.inserted.virtual.alpha)
        result = alpha.copy()
        self.box.paste(coverage_with(self.box.cut(alpha, "edge"), self.inserted.virtual.alpha), result)
        return result

    def whole(self, rgb: Rgb) -> Inserted:
        """As if it had been made in the whole frame."""
        if self.box is None:
            return self.inserted
        photo_rgb = rgb.copy()
        self.box.paste(self.inserted.photo_rgb, photo_rgb)
        return Inserted(photo_rgb, self.box.placed(replace(self.inserted.virtual, extra={}), rgb.shape))


class BoxedInsertion:
    """insert: as of an Insertion, but a Part. Give it the very same layers, depth and lens as long as they do not change."""

    def __init__(self, insertion: Insertion, renderer: Renderer, *, local: bool) -> None:
        """local: whether the renderer spreads light no farther than the circle of confusion."""
        self._insertion, self._renderer = insertion, renderer
        plain = insertion.insertion if isinstance(insertion, InTouchedBox) else insertion
        self._keeps = local and isinstance(plain, OverPhotograph)
        self._by_depth = isinstance(plain, OverPhotograph) and plain.by_depth
        self._box, self._cut = Kept(_reached_box), Kept(_cut_layers)
        self._hidden, self._blurred = Kept(_hidden_layers), Kept(self._blur)

    def insert(self, plate: Plate, layers: Sequence[Layer]) -> Part:
        if not (self._keeps and is_same_everywhere(plate.lens)):
            return Part(None, self._insertion.insert(plate, layers, self._renderer))
        box = self._box(same_size(plate, layers), plate.lens)
        if box.is_empty:
            return Part(box, Inserted(plate.rgb[:0, :0], clear(0, 0)))
        visible = self._cut(layers, box)
        if self._by_depth and plate.depth_m is not None:
            visible = self._hidden(visible, plate.depth_m, box)
        virtual = self._blurred(visible, plate.lens, plate.rgb.shape[1])
        return Part(box, Inserted(behind(box.cut(plate.rgb, "edge"), virtual), virtual))

    def _blur(self, layers: Sequence[Layer], lens: Lens, frame_width_px: int) -> Layer:
        """With so much of the sensor as sees the box, so that circles of confusion keep their size."""
        if not any(layer.alpha.any() or layer.rgb.any() for layer in layers):
            return flatten(layers)
        box = Box(0, layers[0].height_px, 0, layers[0].width_px)
        return self._renderer.render(layers, box.lens_of(lens, frame_width_px))


def _reached_box(layers: Sequence[Layer], lens: Lens) -> Box:
    """Within the frame, for the photograph is not blurred again."""
    if not layers:
        return NOWHERE
    blank = np.broadcast_to(np.float32(0.0), (*layers[0].alpha.shape, 3))
    return touched_box(plate_of(blank, lens), layers)


def _cut_layers(layers: Sequence[Layer], box: Box) -> list[Layer]:
    return [box.cut_layer(each) for each in layers]


def _hidden_layers(layers: Sequence[Layer], photo_depth_m: Plane, box: Box) -> list[Layer]:
    cut_m = box.cut(photo_depth_m, "edge")
    return [covered_by(layer, occlusion_matte(layer.depth_m, cut_m)) for layer in layers]
