"""Rolling shutter: a picture of one moment becomes one whose rows are seen one after the other."""

import cv2
import numpy as np
from jaxtyping import Float64

from mrbokeh.distortion.warping import resampled
from mrbokeh.images.layer import Layer
from mrbokeh.scene.moving_layers.paths import Paths
from mrbokeh.scene.moving_layers.shutter import ShutterTiming

_STEPS = 10
_CLOSE_PX = 0.01


def rolled(layer: Layer, paths: Paths, span_s: float, shutter: ShutterTiming) -> Layer:
    """The layer of the middle row's moment, moved row by row along its paths to where each row sees it.

    paths: over `span_s`, of what the layer shows. Motion channels become what the rows see of them: what runs with the readout
    is drawn longer. Things that move differently side by side are told apart only where they are in the middle.
    """
    box = paths.box.grown(int(np.ceil(paths.length_px)) + 1).within(layer.alpha.shape)
    x, y = np.meshgrid(np.arange(box.left - 1, box.right + 1) + 0.5, np.arange(box.top - 1, box.bottom + 1) + 0.5)
    delay_s = np.array([shutter.row_delay_s(row, layer.height_px) for row in y[:, 0].tolist()]) - 0.5 * shutter.readout_s
    positions_px = _sources_px(np.stack([x, y], axis=-1), paths, delay_s / span_s)
    return box.placed(resampled(layer, positions_px, paths.box), layer.alpha.shape)


def _sources_px(
    xy_px: Float64[np.ndarray, "rows columns 2"], paths: Paths, delays: Float64[np.ndarray, " rows"]
) -> Float64[np.ndarray, "rows columns 2"]:
    """The places p with p + motion(p) delay = xy, by repeated substitution."""
    found = xy_px
    for _ in range(_STEPS):
        at = (found - (paths.box.left + 0.5, paths.box.top + 0.5)).astype(np.float32)
        motion_px = cv2.remap(paths.motion_px, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        last, found = found, xy_px - motion_px.astype(np.float64) * delays[:, None, None]
        if np.abs(found - last).max() < _CLOSE_PX:
            break
    return found
