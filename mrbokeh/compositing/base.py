"""What every way of putting virtual layers into a photograph is: a plate, layers and a renderer in, a picture in two parts out.

Every insertion owes these (tests/compositing/test_compositing.py asks all of them):
- identity: where no light of a layer arrives and none of the photograph is hidden, the picture is the plate bit for bit;
- no layers give the plate;
- an opaque layer in focus before everything replaces the plate where it covers the pixel;
- a layer behind everything changes nothing where depth is known;
- linearity: twice the light in plate and layers gives twice the picture.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.plate import Plate
from mrbokeh.images.layer import Layer
from mrbokeh.renderers.base import Renderer
from mrbokeh.system.errors import InputError


@dataclass(frozen=True)
class Inserted:
    """A photograph with virtual layers in it, in two parts, so that grain and the like can be put on the virtual part alone.

    photo_rgb: (H, W, 3) what is left of the photograph: its own numbers where nothing was put in.
    virtual: light of the layers as it arrives, blurred and partly hidden, premultiplied; alpha is the share of the pupil
      that sees them; depth_m is theirs, sharp, front first.
    """

    photo_rgb: Float32[np.ndarray, "height width 3"]
    virtual: Layer

    @property
    def rgb(self) -> Float32[np.ndarray, "height width 3"]:
        return self.photo_rgb + self.virtual.rgb


@runtime_checkable
class Insertion(Protocol):
    """A way of putting layers in; its settings are its constructor's."""

    def insert(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        """Virtual layers, sharp, front first, of the plate's size, blurred by the plate's lens; the plate is not blurred again."""
        ...


def same_size(plate: Plate, layers: Sequence[Layer]) -> Sequence[Layer]:
    """The layers, once each is as large as the plate. Raises InputError where one is not."""
    height, width = plate.rgb.shape[:2]
    for layer in layers:
        if layer.alpha.shape != (height, width):
            raise InputError(
                f"the virtual layer is {layer.width_px}x{layer.height_px} px but the photograph is {width}x{height} px: "
                f"render or resize it to that size"
            )
    return layers
