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
from mrbokeh.depth.depth_filters import interpolate
from mrbokeh.depth.edge_votes import Guide, Mask, grown, narrowed
from mrbokeh.depth.soft_edges import steepened

Plane = Float32[np.ndarray, "height width"]
Rgb = Float32[np.ndarray, "height width 3"]

_RANGE = (0.5, 99.5)
_JUMP, _LEAST_JUMP = 0.1, 0.7
"""Two surfaces are this share of all slices that are sharp somewhere apart, and so many slices at least."""
_SOFT_PX, _SPECK_PX, _RAMP_PX = 1.3, 3, 3
"""How soft edges of depth from focus are (standard deviation), what is a speck, and how far a ramp reaches beside an edge."""
_TRUSTED = 0.02
"""Least confidence of a place that stands for its surface."""
_SMALL_PX = 0.6e6
_COARSE_REACHES_PX, _FINE_REACHES_PX = (8, 8), (4,)
"""How far edges are moved, in passes: in a picture of SMALL_PX pixels at most, and in each that is twice as large, for what is left."""
_SMOOTHNESS, _CONTRAST, _LEAST_TRUST, _WHITE = 13_000.0, 2.0 / 255.0, np.float32(1e-4), 99.5
_SAME_SURFACE, _LARGEST_SHARE = 1.5, 0.5
"""Depth is evened out by so many jumps at most, and this share of its range: what differs by more is something of its own."""
_GUESSED, _GUESSED_AROUND, _AROUND_PX = 0.05, 0.1, 21
"""A place is a guess below this confidence, or where that around it is below this in the mean: it may be evened out by any amount. Plain
walls beside near things had the depth of these, and cut holes into objects before them."""
_RIM_SHARE = 0.02
"""What is left of the rims of near things lies on the farther surface. So of the confidence of near places beside farther ones only this
share counts for all places but these themselves. Traced (a desk of RAW, two rooms, checkers and a fence before walls), with guesses and
rims so treated the mean error is 7, 5, 24, 14 and 20 % less."""


def with_edges_of_light(focus: FocusMap, sharp_rgb: Rgb, near_first: bool) -> FocusMap:
    """Return depth from focus whose near things are no wider than in the picture. near_first: the first slice is focused nearest."""
    sign = np.float32(-1.0 if near_first else 1.0)
    nearness = sign * focus.focus_index
    low, high = np.percentile(nearness[::4, ::4], _RANGE)
    jump = max(_JUMP * float(high - low), _LEAST_JUMP)
    nearness = _from_coarse_to_fine(nearness, sharp_rgb, focus.confidence > _TRUSTED, jump)
    most = min(_SAME_SURFACE * jump, _LARGEST_SHARE * float(high - low))
    around = np.minimum(cv2.blur(focus.confidence, (_AROUND_PX, _AROUND_PX)) / np.float32(_GUESSED_AROUND), np.float32(1.0))
    guessed = (focus.confidence < _GUESSED) | (around < 1.0)
    if high - low <= 1.0:  # of two slices the surer one would take all
        guessed[:] = False
    elif focus.lit is not None:
        guessed &= ~focus.lit
    even = _evened(nearness, focus.confidence * around * around, sharp_rgb, guessed, jump)
    return replace(focus, focus_index=sign * np.where(guessed | (np.abs(even - nearness) <= most), even, nearness))


def _from_coarse_to_fine(nearness: Plane, rgb: Rgb, trusted: Mask, jump: float) -> Plane:
    """Return nearness in slices with its edges moved, first in half as many rows and columns where the picture is large."""
    if nearness.size <= _SMALL_PX:
        return _moved(nearness, rgb, trusted, jump, _COARSE_REACHES_PX)
    height, width = nearness.shape
    small_rgb = cv2.resize(rgb, (-(-width // 2), -(-height // 2)), interpolation=cv2.INTER_AREA)
    coarse = _from_coarse_to_fine(nearness[::2, ::2], small_rgb, trusted[::2, ::2], jump)
    # A coarse pixel too wide, so that what is left can only be too wide.
    grown_px = cv2.dilate(coarse, np.ones((3, 3), np.uint8)).repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return _moved(np.where(nearness - grown_px > jump, grown_px, nearness), rgb, trusted, jump, _FINE_REACHES_PX)


def _moved(nearness: Plane, rgb: Rgb, trusted: Mask, jump: float, reaches_px: Sequence[int]) -> Plane:
    """Return nearness with its edges moved, all else as it was."""
    hard = now = steepened(cv2.medianBlur(np.ascontiguousarray(nearness), _SPECK_PX), jump, _SOFT_PX)
    guide = Guide.of(rgb)
    for reach_px in reaches_px:
        now = narrowed(now, guide, jump, trusted, reach_px)
    # What was a ramp beside a place that has moved would stay as a line of a depth that is nobody's.
    return np.where(grown(now != hard, _RAMP_PX), now, nearness)


def _evened(nearness: Plane, says: Plane, rgb: Rgb, guessed: Mask, jump: float) -> Plane:
    """Return nearness as places say, each as far as it may, up to edges of the picture."""
    root = np.sqrt(np.maximum(rgb, np.float32(0.0)))
    guide = np.minimum(root / np.float32(max(np.percentile(root[::4, ::4], _WHITE), 1e-6)), np.float32(1.0))
    even = interpolate(nearness, np.maximum(says, _LEAST_TRUST), guide, _SMOOTHNESS, _CONTRAST)
    rim = nearness - cv2.erode(nearness, np.ones((_AROUND_PX, _AROUND_PX), np.uint8)) > jump
    if rim.any():
        without_rims = np.maximum(np.where(rim, np.float32(_RIM_SHARE) * says, says), _LEAST_TRUST)
        even = np.where(rim & ~guessed, even, interpolate(nearness, without_rims, guide, _SMOOTHNESS, _CONTRAST))
    return np.clip(even, nearness.min(), nearness.max())
