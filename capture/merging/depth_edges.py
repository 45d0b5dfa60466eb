"""Depth from focus as the all-in-focus picture has it: edges where it has them, surfaces as even as they are.

The edge of a near thing, sharp in its own slice, is the strongest detail as far as the window of the focus energy reaches; so near things
come out too wide. In two traced stacks two of three pixels beside an edge, and half of those 4 px away, were taken for the near side. The
picture is right there, for the far side is hidden in every other slice behind the blur of the near one; its depth is not. What a pixel
belongs to is told by its colour. Within a surface depth is as uncertain as its detail is faint: what is sure there speaks for the rest
(fast global smoothing, Min et al. 2014, section V-C).
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float32

from capture.merging.depth_from_focus import FocusMap
from mrbokeh.depth.edge_votes import Guide, Mask, grown, narrowed
from mrbokeh.depth.soft_edges import steepened

Plane = Float32[np.ndarray, "height width"]
Rgb = Float32[np.ndarray, "height width 3"]

_RANGE = (0.5, 99.5)
_JUMP, _LEAST_JUMP = 0.1, 0.7
"""Two surfaces are this share of all slices that are sharp somewhere apart, and so many slices at least."""
_SOFT_PX, _SPECK_PX, _RAMP_PX = 1.3, 3, 3
_TRUSTED = 0.02
_SMALL_PX = 0.3e6
_REACHES_PX = (8, 8), (4,)
"""How far edges are moved in each pass: first in a picture of some SMALL_PX pixels, for windows are wider in larger ones, then in it."""
_SMOOTHING, _COLOUR, _LEAST_TRUST, _WHITE = 5000.0, 2.0, np.float32(1e-4), 99.5
_SAME_SURFACE = 1.5
"""Depth is evened out by so many jumps at most: what differs by more is something of its own."""


def with_edges_of_light(focus: FocusMap, sharp_rgb: Rgb, near_first: bool) -> FocusMap:
    """Return depth from focus whose near things are no wider than in the picture. near_first: the first slice is focused nearest."""
    sign = np.float32(-1.0 if near_first else 1.0)
    nearness, trusted = sign * focus.focus_index, focus.confidence > _TRUSTED
    low, high = np.percentile(nearness[::4, ::4], _RANGE)
    jump = max(_JUMP * float(high - low), _LEAST_JUMP)
    shrink = max(1, round((nearness.size / _SMALL_PX) ** 0.5))
    size, small_size = nearness.shape[::-1], tuple(-(-each // shrink) for each in nearness.shape[::-1])
    small, sure = (cv2.resize(each, small_size, interpolation=cv2.INTER_NEAREST) for each in (nearness, trusted.astype(np.uint8)))
    moved = _moved(small, cv2.resize(sharp_rgb, small_size, interpolation=cv2.INTER_AREA), sure > 0, jump, _REACHES_PX[0])
    changed, moved = (cv2.resize(each, size, interpolation=cv2.INTER_NEAREST) for each in ((moved != small).astype(np.uint8), moved))
    index = sign * _moved(np.where(changed > 0, moved, nearness), sharp_rgb, trusted, jump, _REACHES_PX[1])
    return replace(focus, focus_index=_evened(index, focus.confidence, sharp_rgb, _SAME_SURFACE * jump))


def _moved(nearness: Plane, rgb: Rgb, trusted: Mask, jump: float, reaches_px: Sequence[int]) -> Plane:
    """Return nearness in slices with its edges moved, all else as it was."""
    hard = now = steepened(cv2.medianBlur(nearness, _SPECK_PX), jump, _SOFT_PX)
    guide = Guide.of(rgb)
    for reach_px in reaches_px:
        now = narrowed(now, guide, jump, trusted, reach_px)
    # What was a ramp beside a place that has moved would stay as a line of a depth that is nobody's.
    return np.where(grown(now != hard, _RAMP_PX), now, nearness)


def _evened(index: Plane, confidence: Plane, rgb: Rgb, most: float) -> Plane:
    """Return the index as its confident places say, up to edges of the picture, and changed by so much at most."""
    root = np.sqrt(np.maximum(rgb, np.float32(0.0)))
    white = max(float(np.percentile(root[::4, ::4], _WHITE)), 1e-6)
    guide = np.minimum(root * np.float32(255.0 / white), np.float32(255.0)).astype(np.uint8)
    trust = np.maximum(confidence.astype(np.float32), _LEAST_TRUST)
    smoother = cv2.ximgproc.createFastGlobalSmootherFilter(guide, _SMOOTHING, _COLOUR)
    even = np.clip(smoother.filter(trust * index) / smoother.filter(trust), index.min(), index.max())
    return np.where(np.abs(even - index) <= most, even, index)
