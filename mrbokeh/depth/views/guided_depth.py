"""Depth maps guided by the picture: semi-global labelling, and weighted medians at edges.

The labelling (Hirschmueller 2008) turns costs of planes into one plane per pixel and lets depth jump where the picture does. Weighted
medians (Ma et al. 2013) move edges of depth onto edges of the picture, since windows extend a near surface beyond its end.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, UInt8

from mrbokeh.system.resources import in_bands, workers

Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Guide = Float32[np.ndarray, "height width colours"]

_LEAST_BAND = 32
Costs = UInt8[np.ndarray, "height width planes"]
_PATHS = 8
_RIVAL_APART = 2


def near_steps(values: Plane, radius_px: int, least: float) -> Mask:
    """Mark pixels with a step between neighbours of `least` or more within the radius."""
    steps = np.zeros(values.shape, np.uint8)
    steps[:, 1:] |= np.abs(np.diff(values, axis=1)) >= least
    steps[1:] |= np.abs(np.diff(values, axis=0)) >= least
    return cv2.dilate(steps, np.ones((2 * radius_px + 1, 2 * radius_px + 1), np.uint8)).astype(bool)


def weighted_medians(values: Plane, weights: Plane, guide: Guide, where: Mask, radius_px: int, contrast: float) -> Plane:
    """Replace marked pixels by the median of the window weighted by trust and by likeness of colour (Ma et al. 2013).

    contrast: a colour that differs by this much weighs 1/e.
    """
    from mrbokeh.depth.views import _views_numba as compiled

    out = values.copy()
    height, width = values.shape
    fixed = values, weights, np.ascontiguousarray(guide), where, radius_px, contrast
    with workers(height * width) as pool:
        in_bands(pool, height, _LEAST_BAND, lambda first, end: compiled.weighted_medians(*fixed, (first, end), out))
    return out


@dataclass(frozen=True)
class Penalties:
    """Penalties of the labelling.

    small: for a step to the next plane, large: for any farther one (both in units of cost, 255 is no agreement at all).
    contrast: if the guide changes by this much between two pixels, a jump of depth costs half.
    """

    small: float = 30.0
    large: float = 500.0
    contrast: float = 0.02


@dataclass(frozen=True)
class Labels:
    """Labelled planes. index (H, W): fractional index of the plane; margin: lead over the best other plane, per path, in units of cost."""

    index: Plane
    margin: Plane


def label_planes(costs: Costs, guide: Plane, penalties: Penalties | None = None) -> Labels:
    """Label all pixels together. Memory: 2 bytes per cell beside the costs."""
    from mrbokeh.depth.views._views_numba import aggregate, winners

    rules = penalties or Penalties()
    total = aggregate(costs, guide, rules.small, rules.large, rules.contrast)
    index, margin = (np.empty(guide.shape, np.float32) for _ in range(2))
    winners(total, _RIVAL_APART, index, margin)
    return Labels(index, margin / np.float32(_PATHS))
