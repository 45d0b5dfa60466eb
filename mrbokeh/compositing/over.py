"""Blurred layers over a photograph; where its depth is known, what stands in front hides parts of the sharp layers first."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.base import Inserted, same_size
from mrbokeh.compositing.occlusion import covered_by, occlusion_matte
from mrbokeh.compositing.plate import Plate
from mrbokeh.images.layer import Layer, clear, flatten
from mrbokeh.renderers.base import Renderer


@dataclass(frozen=True)
class OverPhotograph:
    """Porter and Duff's "over" of the blurred layers. by_depth: hide what lies behind the photographed scene, where depth is known."""

    by_depth: bool = True

    def insert(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        visible = same_size(plate, layers)
        if self.by_depth and plate.depth_m is not None:
            visible = [covered_by(layer, occlusion_matte(layer.depth_m, plate.depth_m)) for layer in layers]
        blurred = renderer.render(visible, plate.lens) if any(layer.alpha.any() for layer in visible) else _nothing(plate, visible)
        return Inserted(behind(plate.rgb, blurred), blurred)


def behind(photo_rgb: Float32[np.ndarray, "height width 3"], layer: Layer) -> Float32[np.ndarray, "height width 3"]:
    """What is left of an opaque picture behind a layer."""
    return (1.0 - layer.alpha[..., None]) * photo_rgb


def _nothing(plate: Plate, layers: Sequence[Layer]) -> Layer:
    return flatten(layers) if layers else clear(*plate.rgb.shape[:2])
