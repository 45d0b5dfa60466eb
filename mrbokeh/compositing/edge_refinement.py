"""Edges of near things moved to where the photograph shows them, for depth maps that are off by a pixel or two.

A wrong edge takes far colour for near all along. The photograph tells where the blurred edge lies, so proposals are tested: the scene
is cut in two with each, blurred anew, and compared with the photograph; around every place the one that explains it better wins. Near
things that depth misses altogether stay missed.

Proposals come from the colours of the sharp picture. A pixel is certainly near if no far pixel lies within reach, or if it lies in the
middle of a thin thing; certainly far likewise. The colours of the rest are projected on the line that separates those of the certain
pixels around them best (Fisher, The Use of Multiple Measurements in Taxonomic Problems, 1936). Colours are taken as v / (v + mean
around), so that highlights do not outweigh all else and twice the light gives the same answer.
"""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

from mrbokeh.compositing.near_and_far import cut_in_two, reach_px, without_edge
from mrbokeh.compositing.plate import Plate
from mrbokeh.layering.hidden_background import continued
from mrbokeh.layering.highlights import find_highlights
from mrbokeh.renderers.base import Renderer
from mrbokeh.system.resources import in_bands, workers

REACH_PX = 2
"""How far depth may be off."""
_WINDOW_PX = 5
_BAND_PLACES = 512
_LEAST_APART = 4.0
_FAR_BELOW, _NEAR_ABOVE, _SURELY_NEAR = 0.4, 0.6, 0.75

Plane = Float32[np.ndarray, "height width"]
Picture = Float32[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]

_HALF = 0.5
_AROUND_PX = 4.0
_LARGE_PX = 2_000_000
"""Above it half as many rows and columns are compared: a pixel is little there, and time is short."""
_FLOOR, _ROUND = np.float32(0.1), np.float32(1e-6)


@dataclass(frozen=True)
class EdgeColours:
    """Evidence of the colours around depth edges.

    near: by depth. unsure: pixels at which depth may be wrong. nearness: 0 as the far side, 1 as the near one; NaN if colours do not
    tell. lit: highlights and their neighbours, whose colour tells nothing.
    """

    near: Mask
    unsure: Mask
    nearness: Plane
    lit: Mask

    @classmethod
    def of(cls, rgb: Picture, near: Mask, at_edge: Mask) -> "EdgeColours":
        """Classify pixels. rgb: all in focus. at_edge: pixels at which depth has an edge; elsewhere it is right."""
        from cv2 import dilate

        lit = np.asarray(dilate(find_highlights(rgb).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
        near_sure, near_unsure = _certain(near)
        far_sure, far_unsure = _certain(~near)
        unsure = (near_unsure | far_unsure) & at_edge
        sides = (near_sure & ~lit).astype(np.uint8) + np.uint8(2) * (far_sure & ~lit).astype(np.uint8)
        nearness = np.full(near.shape, np.nan, np.float32)
        places = np.flatnonzero(unsure & ~lit)
        nearness.reshape(-1)[places] = _nearness(np.ascontiguousarray(rgb), sides, places)
        return cls(near, unsure, nearness, lit)

    def by_colour(self) -> Mask:
        """Return what is near where colours decide; highlights at edges count as far."""
        told = self.near.copy()
        told[self.nearness < _FAR_BELOW] = False
        told[self.nearness > _NEAR_ABOVE] = True
        told[self.unsure & self.lit] = False
        return told

    def without_rim(self) -> Mask:
        """Return what is near less a pixel at its edges, except where colours say near, and the middle of thin things."""
        from cv2 import erode

        inner = np.asarray(erode(self.near.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
        return np.asarray(self.near & (inner | ~self.unsure | (self.nearness > _SURELY_NEAR)))


def _certain(mask: Mask) -> tuple[Mask, Mask]:
    """Return (certainly in the mask, in it but perhaps not)."""
    from cv2 import DIST_L2, dilate, distanceTransform

    depth_px = distanceTransform(mask.astype(np.uint8), DIST_L2, 5)
    size = 2 * REACH_PX + 1
    deepest_px = dilate(depth_px, np.ones((size, size), np.uint8))
    sure = mask & (depth_px >= np.minimum(REACH_PX + 1.0, deepest_px) - 1e-3)
    return np.asarray(sure), np.asarray(mask & ~sure)


def _nearness(rgb: Picture, sides: UInt8[np.ndarray, "height width"], places: Int64[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    from mrbokeh.compositing._between_numba import nearness

    found = np.zeros((len(places), 2), np.float32)
    with workers(len(places) * 100) as pool:
        in_bands(pool, len(places), _BAND_PLACES, lambda first, end: nearness(found, places, rgb, sides, _WINDOW_PX, first, end))
    return np.where(found[:, 1] > _LEAST_APART, found[:, 0], np.float32(np.nan)).astype(np.float32)


_PROPOSED = ((EdgeColours.without_rim, np.float32(0.9)), (EdgeColours.by_colour, np.float32(1.0)))
"""One after the other. Each wins where it leaves less than this part of the error."""


def with_refined_edges(plate: Plate, matte: Plane, renderer: Renderer, tolerance: float) -> tuple[Plate, Plane]:
    """Return the plate with its depth moved at rims, and the matte of what is near then. matte: by the depth that it has. tolerance: see
    `Between`.

    The very same where nothing better is found, for a user's matte, and where there is no sharp picture and depth to look at.
    """
    near = matte > _HALF
    if plate.near_alpha is not None or plate.sharp_rgb is None or plate.depth_m is None or not near.any() or near.all():
        return plate, matte
    at_edge = ~without_edge(plate.depth_m, tolerance)
    best, error = near, None
    for propose, part in _PROPOSED:
        proposed = propose(EdgeColours.of(plate.sharp_rgb, best, at_edge))
        if not (proposed != best).any():
            continue
        error = _error(plate, near, best, renderer, tolerance) if error is None else error
        other = _error(plate, near, proposed, renderer, tolerance)
        better = other < part * error
        best, error = np.where(better, proposed, best), np.where(better, other, error)
    return (plate, matte) if best is near else (replace(plate, depth_m=moved(plate.depth_m, near, best)), best.astype(np.float32))


def _error(plate: Plate, near: Mask, proposed: Mask, renderer: Renderer, tolerance: float) -> Plane:
    """Return how badly the scene, cut so and blurred anew, explains the photograph around each pixel; relative to its light,
    squared.
    """
    from cv2 import GaussianBlur, resize

    assert plate.depth_m is not None
    tried, mask = replace(plate, depth_m=moved(plate.depth_m, near, proposed)), proposed
    around_px = _AROUND_PX
    if near.size > _LARGE_PX:
        tried, mask, around_px = _halved(tried), _half_of(proposed), 0.5 * _AROUND_PX
    assert tried.sharp_rgb is not None and tried.depth_m is not None
    scene = cut_in_two(tried.sharp_rgb, tried.depth_m, mask, reach_px(tried.lens, tried.depth_m, mask), tolerance)
    anew = np.maximum(renderer.render([scene.near, scene.far], tried.lens).rgb, 0.0)
    around = GaussianBlur(tried.rgb, (0, 0), around_px)
    off = (np.abs(anew - tried.rgb) / (anew + tried.rgb + _FLOOR * around + _ROUND)).sum(axis=2)
    found = GaussianBlur(off * off, (0, 0), around_px)
    return np.asarray(found if found.shape == near.shape else resize(found, near.shape[::-1]), np.float32)


def _halved(plate: Plate) -> Plate:
    """Half as wide and high; the lens blurs by half as many pixels, for it goes by the width."""
    from cv2 import INTER_AREA, resize

    assert plate.depth_m is not None and plate.sharp_rgb is not None
    height, width = plate.depth_m.shape
    rgb, sharp_rgb = (
        np.asarray(resize(each, (width // 2, height // 2), interpolation=INTER_AREA)) for each in (plate.rgb, plate.sharp_rgb)
    )
    return replace(plate, rgb=rgb, sharp_rgb=sharp_rgb, depth_m=_half_of(plate.depth_m))


def _half_of(plane: np.ndarray) -> np.ndarray:
    """Every other pixel of every other row."""
    return np.ascontiguousarray(plane[: plane.shape[0] // 2 * 2 : 2, : plane.shape[1] // 2 * 2 : 2])


def moved(depth_m: Plane, near: Mask, now_near: Mask) -> Plane:
    """Depth in which what has become near, or far, has the depth of the nearest pixel that was so before."""
    result = depth_m.copy()
    for was, stays, gained in ((near, near & now_near, now_near & ~near), (~near, ~near & ~now_near, near & ~now_near)):
        known = stays if stays.any() else was
        if gained.any() and known.any():
            result[gained] = continued(depth_m, known)[gained]
    return result
