"""Blurred layers over a photograph; where its depth is known, nearer things hide parts of the sharp layers first.

The hidden part is decided on sharp layers, before the blur (Mandl et al. 2024, Section 3.4). SmoothedMatte is the matte of that paper
(Neural Bokeh): a white object on black, hidden by depth, eroded and smoothed while still sharp.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from mrbokeh.compositing.near_and_far import TOLERANCE, with_told_depth
from mrbokeh.compositing.plate import Inserted, Plate, same_size
from mrbokeh.images.layer import Layer, clear, flatten
from mrbokeh.renderers.base import Renderer
from mrbokeh.system.errors import InputError

Plane = Float32[np.ndarray, "height width"]

_LEAST = np.float32(1e-6)


def occlusion_matte(virtual_depth_m: Plane, photo_depth_m: Plane, tolerance: float = TOLERANCE, softness: float = 0.02) -> Plane:
    """Return the share of the virtual surface that the photographed scene leaves visible: 1 in front of it, 0 behind it.

    Depths are compared by their ratio. The photographed surface must be nearer by more than `tolerance` (a share of the depth, the size
    of the error of depth from focus) to hide the virtual one, so that what stands on it does not sink in; over `softness` the matte
    goes from 1 to 0, so that depth noise does not fray it.
    """
    there = np.isfinite(virtual_depth_m)
    behind_by = np.zeros_like(virtual_depth_m)
    np.divide(virtual_depth_m, photo_depth_m, out=behind_by, where=there)
    matte = np.clip(0.5 + (1.0 + tolerance - behind_by) / softness, 0.0, 1.0)
    return np.where(there, matte, 0.0).astype(np.float32)


def covered_by(layer: Layer, matte: Plane) -> Layer:
    """A layer seen through a matte (H, W) in [0, 1]."""
    return replace(layer, rgb=layer.rgb * matte[..., None], alpha=layer.alpha * matte)


@dataclass(frozen=True)
class OverPhotograph:
    """Porter and Duff's "over" of the blurred layers. by_depth: hide what lies behind the photographed scene, by depth or a matte."""

    by_depth: bool = True

    def insert(self, plate: Plate, layers: Sequence[Layer], renderer: Renderer) -> Inserted:
        visible = same_size(plate, layers)
        if self.by_depth:
            plate = with_told_depth(plate, layers)
        if self.by_depth and plate.depth_m is not None:
            visible = [covered_by(layer, occlusion_matte(layer.depth_m, plate.depth_m)) for layer in layers]
        if self.by_depth and plate.near_alpha is not None:
            seen = np.float32(1.0) - np.nan_to_num(plate.near_alpha, nan=0.0)
            visible = [covered_by(layer, seen) for layer in visible]
        blurred = renderer.render(visible, plate.lens) if any(layer.alpha.any() for layer in visible) else _nothing(plate, visible)
        return Inserted(behind(plate.rgb, blurred), blurred)


def behind(photo_rgb: Float32[np.ndarray, "height width 3"], layer: Layer) -> Float32[np.ndarray, "height width 3"]:
    """Return the part of an opaque picture that a layer leaves."""
    return (1.0 - layer.alpha[..., None]) * photo_rgb


def _nothing(plate: Plate, layers: Sequence[Layer]) -> Layer:
    return flatten(layers) if layers else clear(*plate.rgb.shape[:2])


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
