"""What of a virtual layer the photographed scene hides, decided on sharp layers, before the blur (Mandl et al. 2024, Section 3.4)."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float32

from mrbokeh.images.layer import Layer

Plane = Float32[np.ndarray, "height width"]


def occlusion_matte(virtual_depth_m: Plane, photo_depth_m: Plane, tolerance: float = 0.03, softness: float = 0.02) -> Plane:
    """How much of the virtual surface the photographed scene leaves visible: 1 in front of it, 0 behind it.

    Depths are compared by their ratio. The photographed surface must be nearer by more than `tolerance` (a share of the
    depth, the size of the error of depth from focus) to hide the virtual one, so that what stands on it does not sink in;
    over `softness` the matte goes from 1 to 0, so that depth noise does not fray it.
    """
    there = np.isfinite(virtual_depth_m)
    behind_by = np.zeros_like(virtual_depth_m)
    np.divide(virtual_depth_m, photo_depth_m, out=behind_by, where=there)
    matte = np.clip(0.5 + (1.0 + tolerance - behind_by) / softness, 0.0, 1.0)
    return np.where(there, matte, 0.0).astype(np.float32)


def covered_by(layer: Layer, matte: Plane) -> Layer:
    """A layer seen through a matte (H, W) in [0, 1]."""
    return replace(layer, rgb=layer.rgb * matte[..., None], alpha=layer.alpha * matte)
