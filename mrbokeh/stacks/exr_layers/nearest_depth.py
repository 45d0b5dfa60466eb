"""Depth of pixels whose own is not theirs: Z is that of one ray, which may have passed by what covers part of the pixel."""

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.images.layer import Layer

# The eight neighbours.
_BESIDE_PX = 1.5


def edges_mended(layer: Layer) -> Layer:
    """Partly covered pixels without depth take that of a pixel beside them. Opaque ones without depth are sky and stay."""
    is_known = np.isfinite(layer.depth_m)
    is_lost = ~is_known & (layer.alpha > 0) & (layer.alpha < 1)
    if not is_lost.any() or not is_known.any():
        return layer
    nearest_m, distance_px = nearest_depth(layer.depth_m, is_known)
    depth_m = np.where(is_lost & (distance_px < _BESIDE_PX), nearest_m, layer.depth_m)
    return Layer(layer.rgb, layer.alpha, depth_m, layer.extra)


def nearest_depth(
    depth_m: Float32[np.ndarray, "height width"], is_known: Bool[np.ndarray, "height width"]
) -> tuple[Float32[np.ndarray, "height width"], np.ndarray]:
    """Of the nearest pixel that is known, and how far away that is, in pixels; at least one has to be."""
    from scipy.ndimage import distance_transform_edt

    distance_px, (rows, columns) = distance_transform_edt(~is_known, return_indices=True)
    return depth_m[rows, columns], distance_px
