"""All blurred anew: the all-in-focus picture with its depth and the virtual layers, through the photograph's lens in one go."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mrbokeh.compositing.base import Inserted, same_size
from mrbokeh.compositing.between import Between
from mrbokeh.compositing.plate import Plate
from mrbokeh.compositing.three_parts import LEAST_LIGHT
from mrbokeh.compositing.virtual_surface import shows_anything
from mrbokeh.images.layer import Layer, clear, flatten
from mrbokeh.renderers.base import Renderer
from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class Rerendered:
    """What virtual light reaches is taken from the new picture, the rest from the photograph. tolerance, true_rims: see `Between`.

    Simpler than `Between` and the same for any lens, but touched pixels show how well the picture is blurred anew, and coverages of
    near and virtual rims are multiplied.
    """

    tolerance: float = 0.03
    true_rims: bool = True

    def insert(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        same_size(plate, layers)
        if plate.sharp_rgb is None or plate.depth_m is None:
            raise InputError(
                "to blur a photograph anew its all-in-focus picture and depth are needed: give a focal stack, or use the mode over"
            )
        if not any(shows_anything(layer) for layer in layers):
            return Inserted(plate.rgb, flatten(layers) if layers else clear(*plate.rgb.shape[:2]))
        scene = Between(self.tolerance, true_rims=self.true_rims).cut(plate, layers, renderer)
        near = [scene.near] if scene.near.alpha.any() else []
        picture = renderer.render([*near, *layers, scene.far], plate.lens)
        virtual = renderer.render(layers, plate.lens)
        free = 1.0 - renderer.render(near, plate.lens).alpha if near else np.ones_like(virtual.alpha)
        seen = Layer(virtual.rgb * free[..., None], virtual.alpha * free, virtual.depth_m)
        touched = (seen.alpha > LEAST_LIGHT) | (np.abs(seen.rgb).max(axis=2) > LEAST_LIGHT)
        left = np.where(touched[..., None], np.maximum(picture.rgb - seen.rgb, 0.0), plate.rgb)
        return Inserted(left, Layer(seen.rgb * touched[..., None], seen.alpha * touched, seen.depth_m))
