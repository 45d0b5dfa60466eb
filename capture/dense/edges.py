"""Edges of a depth map moved onto the edges of the picture: windows see a near surface a little beyond where it ends."""

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.system.workers import in_bands, workers

Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Guide = Float32[np.ndarray, "height width colours"]

_LEAST_BAND = 32


def near_steps(values: Plane, radius_px: int, least: float) -> Mask:
    """Pixels with a step between neighbours of `least` or more within the radius."""
    steps = np.zeros(values.shape, np.uint8)
    steps[:, 1:] |= np.abs(np.diff(values, axis=1)) >= least
    steps[1:] |= np.abs(np.diff(values, axis=0)) >= least
    return cv2.dilate(steps, np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)).astype(bool)


def weighted_medians(values: Plane, weights: Plane, guide: Guide, where: Mask, radius_px: int, contrast: float) -> Plane:
    """Where asked for, the median of the window weighted by trust and by likeness of colour (Ma et al. 2013), else the value itself.

    contrast: a colour that differs by this much weighs 1/e.
    """
    from capture.dense import _edges_numba as compiled

    out = values.copy()
    height, width = values.shape
    fixed = values, weights, np.ascontiguousarray(guide), where, radius_px, contrast
    with workers(height * width) as pool:
        in_bands(pool, height, _LEAST_BAND, lambda first, end: compiled.weighted_medians(*fixed, (first, end), out))
    return out


def weighted_medians_plainly(values: Plane, weights: Plane, guide: Guide, where: Mask, radius_px: int, contrast: float) -> Plane:
    """The plain twin of `weighted_medians`."""
    out = values.copy()
    for y, x in zip(*np.nonzero(where), strict=True):
        window = np.s_[max(y - radius_px, 0) : y + radius_px + 1, max(x - radius_px, 0) : x + radius_px + 1]
        unlike = np.sum((guide[window] - guide[y, x]) ** 2, axis=-1)
        share = (weights[window] * np.exp(-unlike / contrast**2)).ravel()
        order = np.argsort(values[window].ravel())
        passed = np.cumsum(share[order])
        if passed[-1] > 0:
            out[y, x] = values[window].ravel()[order[np.argmax(passed >= 0.5 * passed[-1])]]
    return out
