"""The virtual layers as one surface: where it shows anything, and its depth continued beyond its outline."""

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.compositing.near_and_far import continued
from mrbokeh.images.layer import Layer

Plane = Float32[np.ndarray, "height width"]


def virtual_depth_m(sharp: Layer) -> Plane:
    """Depth of the virtual surface, continued to all places; inf everywhere where there is none."""
    return continued(sharp.depth_m, shows(sharp.rgb, sharp.alpha) & np.isfinite(sharp.depth_m))


def shows_anything(sharp: Layer) -> bool:
    return bool((sharp.alpha > 0).any() or (sharp.rgb > 0).any())


def shows(rgb: Float32[np.ndarray, "height width 3"], alpha: Plane) -> Bool[np.ndarray, "height width"]:
    """Where a layer covers anything or gives light."""
    red, green, blue = (rgb[..., channel] > 0 for channel in range(3))
    return (alpha > 0) | red | green | blue
