"""The matte of Neural Bokeh: a white object on black, hidden by depth, eroded and smoothed while still sharp (Mandl et al. 2024, 3.4)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.base import Inserted, same_size
from mrbokeh.compositing.occlusion import covered_by, occlusion_matte
from mrbokeh.compositing.over import OverPhotograph
from mrbokeh.compositing.plate import Plate
from mrbokeh.images.layer import Layer
from mrbokeh.renderers.base import Renderer
from mrbokeh.system.errors import InputError

Plane = Float32[np.ndarray, "height width"]
_LEAST = np.float32(1e-6)


@dataclass(frozen=True)
class SmoothedMatte:
    """The object rendered white is its coverage; what the photographed scene hides of it is black. Erosion and a Gaussian smooth it.

    erode_px: radius of the erosion, whole pixels. sigma_px: of the Gaussian. Both come before the blur of the lens: eroding what is
    blurred would take the rim off every circle of confusion. The paper names no sizes; these take the stair-steps off a rim.
    """

    erode_px: int = 1
    sigma_px: float = 0.7

    def __post_init__(self) -> None:
        if self.erode_px < 0 or not self.sigma_px >= 0.0:
            raise InputError(f"sizes of the matte's filters are pixels from 0 up, got erosion {self.erode_px} and Gaussian {self.sigma_px}")

    def insert(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        smoothed = [self._smoothed(layer, plate.depth_m) for layer in same_size(plate, layers)]
        return OverPhotograph(by_depth=False).insert(plate, smoothed, renderer)

    def _smoothed(self, layer: Layer, photo_depth_m: Plane | None) -> Layer:
        visible = np.ones_like(layer.alpha) if photo_depth_m is None else occlusion_matte(layer.depth_m, photo_depth_m)
        matte = self.smoothed(layer.alpha * visible)
        share = np.divide(matte, layer.alpha, out=np.zeros_like(matte), where=layer.alpha > _LEAST)
        return covered_by(layer, np.minimum(share, visible))

    def smoothed(self, matte: Plane) -> Plane:
        """A sharp matte eroded, then smoothed; (H, W) in [0, 1]. What the border of the picture cuts off is not eroded."""
        from cv2 import BORDER_REPLICATE, MORPH_ELLIPSE, GaussianBlur, erode, getStructuringElement

        size = 2 * self.erode_px + 1
        result = erode(matte, getStructuringElement(MORPH_ELLIPSE, (size, size))) if self.erode_px else matte
        if self.sigma_px > 0.0:
            result = GaussianBlur(result, (0, 0), self.sigma_px, borderType=BORDER_REPLICATE)
        return np.asarray(result, np.float32)
