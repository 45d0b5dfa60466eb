"""A layer read at any positions: every new pixel is the mean over the area of the old picture that it covers.

The area is an upright box, as wide and high as the new pixel's parallelogram is on average (of the same variance), and never
smaller than an old pixel. All weights are positive and sum to 1: colour does not ring, alpha stays within [0, 1], and colour,
alpha and extra channels keep their proportions. Side by side, boxes of one size leave no gaps, so that light is kept.
"""

import numpy as np
from jaxtyping import Float32, Float64

from mrbokeh.images.layer import Layer
from mrbokeh.layering.motion import motion_channels
from mrbokeh.layering.pixel_box import Box

NO_MOTION = -1


def resampled(layer: Layer, positions_px: Float64[np.ndarray, "rows_and_2 columns_and_2 2"], box: Box) -> Layer:
    """The layer (h, w) seen at positions_px (h + 2, w + 2, 2), which have one more on every side; NaN sees nothing.

    box: outside it the layer is clear (`mrbokeh.layering.pixel_box.lit_box`).

    Depth is that of the nearest covering pixel, never a mixture. Motion becomes that of the new picture, by the derivatives of
    the positions.
    """
    from mrbokeh.distortion._resampling_numba import resample

    height, width = positions_px.shape[0] - 2, positions_px.shape[1] - 2
    parts = [part[box.where] for part in (layer.rgb, layer.alpha[..., None], *layer.extra.values())]
    source = np.concatenate(parts, axis=2)
    motion = motion_channels(layer.extra)
    values, depth_m = np.zeros((height, width, source.shape[2]), np.float32), np.full((height, width), np.inf, np.float32)
    if not box.is_empty:
        shifted_px = positions_px - (box.left, box.top)
        first = NO_MOTION if motion is None else motion.start
        resample(source, np.ascontiguousarray(layer.depth_m[box.where]), shifted_px, first, np.zeros(source.shape[2]), values, depth_m)
    return _layer(values, depth_m, layer)


def _layer(values: Float32[np.ndarray, "height width channels"], depth_m: Float32[np.ndarray, "height width"], like: Layer) -> Layer:
    # Sums of weights round to a little over 1.
    alpha = np.minimum(values[..., 3], np.float32(1.0))
    extra, start = {}, 4
    for name, channels in like.extra.items():
        extra[name] = values[..., start : start + channels.shape[2]].copy()
        start += channels.shape[2]
    return Layer(values[..., :3].copy(), alpha, np.where(alpha > 0, depth_m, np.float32(np.inf)), extra)
