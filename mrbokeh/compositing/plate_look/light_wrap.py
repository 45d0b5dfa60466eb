"""Light wrap: light of the photograph around an object spills over its soft edge. A habit of compositors, off by default: a lens's own
flare does it, and the blurred edge shows the scene behind it already.

With B the mean light of the photograph around a pixel (of what is visible, by a Gaussian), a pixel of coverage a gets
strength * a * (1 - a) * B on top: of the light a B that the object hides there, the share strength * (1 - a). So the energy added to a
picture is strength times the sum of a (1 - a) B, at most a quarter of B in any pixel, and nothing where a is 0 or 1.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer
from mrbokeh.system.errors import InputError

_SIGMAS = 3


@dataclass(frozen=True)
class LightWrap:
    """strength: 0 to 1. sigma_px: how far around a pixel the photograph is averaged."""

    strength: float
    sigma_px: float = 8.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.strength <= 1.0 or not 0.0 < self.sigma_px < float("inf"):
            raise InputError(
                f"expected a light wrap of strength 0 to 1 and a radius above 0 px, got {self.strength:g} and {self.sigma_px:g} px"
            )

    @property
    def reach_px(self) -> int:
        return int(np.ceil(_SIGMAS * self.sigma_px))

    def wrapped(self, layer: Layer, photo_rgb: Float32[np.ndarray, "height width 3"]) -> Layer:
        """photo_rgb: what is left of the photograph, (1 - a) P. Within reach_px of a border the mean misses what lies beyond."""
        free = 1.0 - layer.alpha
        visible, weight = self._blurred(photo_rgb), self._blurred(free)
        around = visible / np.maximum(weight, 1e-6)[..., None]
        share = np.float32(self.strength) * layer.alpha * free
        return replace(layer, rgb=layer.rgb + share[..., None] * around)

    def _blurred(self, values: np.ndarray) -> np.ndarray:
        import cv2

        side = 2 * self.reach_px + 1
        return cv2.GaussianBlur(values, (side, side), self.sigma_px, borderType=cv2.BORDER_REPLICATE)
