"""LightChange: the change that objects make to the light of a real surface, as pictures and as a layer."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32, Int64

from mrbokeh.images.color import luminance
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.scene.embree.embree_raycaster import EmbreeRaycaster
from mrbokeh.scene.material import Material
from mrbokeh.scene.mesh import Mesh
from mrbokeh.scene.virtual_scene import Scene
from mrbokeh.system.errors import InputError

LEAST_CHANGE = 1.0 / 1024
"""Changes of less than this share of the surface's light are cut off, so that far from the objects a photograph stays what it is."""


@dataclass(frozen=True, eq=False)
class LightChange:
    """Change of light on a real surface.

    ratio: (H, W, 3) share of the surface's light that remains, 0 to 1; 1 if nothing changes. added: (H, W, 3) radiance that the surface
    sends in addition. alpha: (H, W) coverage of the pixel by the surface. depth_m: (H, W) of the surface, inf outside it.
    """

    ratio: Float32[np.ndarray, "height width 3"]
    added: Float32[np.ndarray, "height width 3"]
    alpha: Float32[np.ndarray, "height width"]
    depth_m: Float32[np.ndarray, "height width"]

    def evenly(self) -> "LightChange":
        """Return the same change with all colours losing what their luminance loses; `as_layer` then needs no plate."""
        share = np.where((self.ratio == 1.0).all(-1), 1.0, luminance(self.ratio)).astype(np.float32)
        return replace(self, ratio=np.repeat(share[..., None], 3, axis=2))

    def weakened(self, share: float) -> "LightChange":
        """Return a share of the change, 0 to 1."""
        if share == 1.0:
            return self
        factor = np.float32(share)
        return replace(self, ratio=1 - factor * (1 - self.ratio), added=factor * self.added)

    def deepened(self, contrast: float) -> "LightChange":
        """Return the change as shown by a camera whose tones are a power of the light."""
        return self if contrast == 1.0 else replace(self, ratio=self.ratio ** np.float32(contrast))

    def enlarged(self, height_px: int, width_px: int) -> "LightChange":
        """Return the same change with more pixels; depth of a plane stays exact."""
        import cv2

        if self.alpha.shape == (height_px, width_px):
            return self
        planes = (self.ratio, self.added, self.alpha, 1 / self.depth_m)
        ratio, added, alpha, near = (cv2.resize(each, (width_px, height_px), interpolation=cv2.INTER_LINEAR) for each in planes)
        with np.errstate(divide="ignore"):
            return LightChange(ratio, added, alpha, 1 / near)

    def as_layer(self, sharp_rgb: Float32[np.ndarray, "height width 3"]) -> Layer:
        """A layer lying on the surface that turns a plate beneath into plate * ratio + added; the lens blurs it like any other.

        sharp_rgb: the plate, all in focus where there is such a picture. A layer has one alpha, so it takes away what is lost of
        the colour that loses most and gives the others back from sharp_rgb; nothing in it is negative.
        """
        if sharp_rgb.shape != self.ratio.shape:
            raise InputError(
                f"expected a plate of the shape {self.ratio.shape} of the light change, got {sharp_rgb.shape}: render both alike"
            )
        # Light without any coverage would be lost on renderers that look at covered pixels only.
        takes = 1.0 - np.minimum(np.minimum(self.ratio[..., 0], self.ratio[..., 1]), self.ratio[..., 2])
        takes = np.maximum(takes, np.float32(LEAST_CHANGE) * self.added.any(axis=-1))
        alpha, depth_m = self.alpha * takes, np.full(takes.shape, np.inf, np.float32)
        rgb, some = np.zeros_like(self.ratio), alpha > 0.0
        depth_m[some] = self.depth_m[some]
        gives_back = np.maximum(self.ratio[some] - (1.0 - takes[some])[:, None], 0.0)
        rgb[some] = self.alpha[some][:, None] * (self.added[some] + gives_back * np.maximum(sharp_rgb[some], 0.0))
        return Layer(rgb, alpha, depth_m)


def seen_surface(caster: EmbreeRaycaster, camera: Camera, catcher: Mesh) -> Layer:
    """Coverage and depth of a catcher by itself, from whichever side it is seen."""
    shape = replace(catcher, catches_shadow=False, material=Material(base_color=(0.0, 0.0, 0.0, 1.0), unlit=True, double_sided=True))
    return caster.render(Scene((shape,)), camera)


def changed(
    surface: Layer,
    pixels: Int64[np.ndarray, " pixels"],
    light: tuple[Float32[np.ndarray, "pixels 3"], Float32[np.ndarray, "pixels 3"], Float32[np.ndarray, "pixels 3"]],
) -> LightChange:
    """Build a LightChange from light at some pixels (row after row): (all light before, part that is taken away, part that is added)."""
    total, taken, added = light
    largest = np.maximum(total.max(-1, keepdims=True), 1e-12)
    lost = np.clip(taken / np.maximum(total, 1e-12), 0.0, 1.0)
    ratio, more = np.ones_like(surface.rgb).reshape(-1, 3), np.zeros_like(surface.rgb).reshape(-1, 3)
    ratio[pixels] = np.where(lost.max(-1, keepdims=True) >= LEAST_CHANGE, 1.0 - lost, 1.0)
    more[pixels] = np.where(added.max(-1, keepdims=True) >= LEAST_CHANGE * largest, added, 0.0)
    shape = surface.rgb.shape
    return LightChange(ratio.reshape(shape), more.reshape(shape), surface.alpha, surface.depth_m)
