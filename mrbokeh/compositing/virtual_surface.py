"""The virtual layers as one surface: where it shows anything, and its depth continued beyond its outline."""

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.compositing.near_and_far import continued
from mrbokeh.layer import Layer

Plane = Float32[np.ndarray, "height width"]


def virtual_depth_m(sharp: Layer) -> Plane:
    """Depth of the virtual surface, continued to all places; inf everywhere where there is none."""
    return continued(sharp.depth_m, shows(sharp) & np.isfinite(sharp.depth_m))


def shows(sharp: Layer) -> Bool[np.ndarray, "height width"]:
    """Where a layer covers anything or gives light."""
    red, green, blue = (sharp.rgb[..., channel] > 0 for channel in range(3))
    return (sharp.alpha > 0) | red | green | blue
