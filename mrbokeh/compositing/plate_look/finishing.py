"""All that makes virtual light look photographed, in the order in which a camera does it.

1. Gain of the colour match: light becomes the photograph's numbers. It belongs before the blur, but blur sums light with weights
   of sum 1 and so commutes with it; after it, it costs one multiplication and the blurred layer can be matched anew without blurring.
2. Vignetting: what of the light the lens sends to a place of the sensor, so after the blur has brought it there.
3. Black: glare and offset lie over everything evenly, so they do not fall off towards the corners.
4. Light wrap: light of the photograph, which has 1 to 3 in it already.
5. Grain: made by the sensor from all light that arrives, so last.
"""

from dataclasses import dataclass, replace

import numpy as np

from mrbokeh.compositing.base import Inserted
from mrbokeh.compositing.plate import Plate
from mrbokeh.compositing.plate_look.colour_match import ColourMatch
from mrbokeh.compositing.plate_look.grain import Grain
from mrbokeh.compositing.plate_look.grain_light import GrainDraw, add_grain_to
from mrbokeh.compositing.plate_look.light_wrap import LightWrap
from mrbokeh.compositing.plate_look.vignetting import Vignetting, darkened
from mrbokeh.images.layer import Layer
from mrbokeh.layering.pixel_box import Box, lit_box
from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class Finishing:
    """None: that step is left out."""

    colour: ColourMatch | None = None
    vignetting: Vignetting | None = None
    grain: Grain | None = None
    light_wrap: LightWrap | None = None

    @property
    def is_nothing(self) -> bool:
        colour = self.colour is None or self.colour.is_nothing
        grain = self.grain is None or self.grain.is_nothing
        return colour and grain and self.vignetting is None and (self.light_wrap is None or self.light_wrap.strength == 0.0)


def finished(inserted: Inserted, plate: Plate, finishing: Finishing, frame: int = 0) -> Inserted:
    """The virtual part finished; the photograph's part stays as it is, and so do all pixels without virtual coverage and light.

    frame: its number in a video, for the draw of the grain. Extra channels and depth of the layer are kept. A Finishing that
    does nothing gives back what came.
    """
    if plate.rgb.shape != inserted.photo_rgb.shape:
        raise InputError(f"expected the plate that was inserted into, of {inserted.photo_rgb.shape}, got one of {plate.rgb.shape}")
    if finishing.is_nothing:
        return inserted
    touched, frame_px = lit_box(replace(inserted.virtual, extra={})), plate.rgb.shape[:2]
    if touched.is_empty:
        return inserted
    box = touched if finishing.light_wrap is None else touched.grown(finishing.light_wrap.reach_px).within(frame_px)
    photo_rgb = box.of(inserted.photo_rgb)
    part = _lit(inserted.virtual, photo_rgb, finishing, box)
    light = np.array(part.rgb)
    if finishing.grain is not None and not finishing.grain.is_nothing:
        draw = GrainDraw(finishing.grain, frame, box.origin_px)
        add_grain_to(light, part.alpha, photo_rgb, box.of(plate.rgb), draw)
    rgb = inserted.virtual.rgb.copy()
    box.of(rgb)[...] = light
    return replace(inserted, virtual=replace(inserted.virtual, rgb=rgb))


def _lit(layer: Layer, photo_rgb: np.ndarray, finishing: Finishing, box: Box) -> Layer:
    """Steps 1 to 4 on one part of the frame."""
    frame_px, colour = layer.alpha.shape, finishing.colour or ColourMatch()
    layer = colour.gained(Layer(box.of(layer.rgb), box.of(layer.alpha), box.of(layer.depth_m)))
    if finishing.vignetting is not None:
        layer = darkened(layer, finishing.vignetting.gain(box, frame_px))
    layer = colour.lifted(layer)
    return layer if finishing.light_wrap is None else finishing.light_wrap.wrapped(layer, photo_rgb)
