"""What the colours of a sharp picture say about the rims of near things, where depth may be off by a pixel or two.

A pixel is certainly near if no far pixel lies within reach, or if it lies in the middle of a thin thing; certainly far likewise. The
colours of the rest are put on the line that parts those of the certain pixels around them best (Fisher, The Use of Multiple
Measurements in Taxonomic Problems, 1936). Colours are taken as v / (v + mean around), so that lights do not outweigh all else and
twice the light gives the same answer.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64, UInt8

from mrbokeh.layering.lit_pixels import lights
from mrbokeh.system.workers import in_bands, workers

REACH_PX = 2
"""How far depth may be off."""
_WINDOW_PX = 5
_BAND_PLACES = 512
_LEAST_APART = 4.0
_FAR_BELOW, _NEAR_ABOVE, _SURELY_NEAR = 0.4, 0.6, 0.75

Plane = Float32[np.ndarray, "height width"]
Picture = Float32[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class RimColours:
    """near: by depth. unsure: where it may be wrong. nearness: 0 as the far side, 1 as the near one; NaN where colours do not tell.

    lit: lights and what is beside them; their colour says nothing.
    """

    near: Mask
    unsure: Mask
    nearness: Plane
    lit: Mask

    @classmethod
    def of(cls, rgb: Picture, near: Mask, at_edge: Mask) -> "RimColours":
        """rgb: all in focus. at_edge: where depth has an edge; elsewhere it is right."""
        from cv2 import dilate

        lit = np.asarray(dilate(lights(rgb).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
        near_sure, near_unsure = _certain(near)
        far_sure, far_unsure = _certain(~near)
        unsure = (near_unsure | far_unsure) & at_edge
        sides = (near_sure & ~lit).astype(np.uint8) + np.uint8(2) * (far_sure & ~lit).astype(np.uint8)
        nearness = np.full(near.shape, np.nan, np.float32)
        places = np.flatnonzero(unsure & ~lit)
        nearness.reshape(-1)[places] = _nearness(np.ascontiguousarray(rgb), sides, places)
        return cls(near, unsure, nearness, lit)

    def by_colour(self) -> Mask:
        """What is near where colours decide; lights at rims are taken for far ones."""
        told = self.near.copy()
        told[self.nearness < _FAR_BELOW] = False
        told[self.nearness > _NEAR_ABOVE] = True
        told[self.unsure & self.lit] = False
        return told

    def without_rim(self) -> Mask:
        """What is near less a pixel at its edges, but for what colours say is near, and the middle of thin things."""
        from cv2 import erode

        inner = np.asarray(erode(self.near.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0)
        return np.asarray(self.near & (inner | ~self.unsure | (self.nearness > _SURELY_NEAR)))


def _certain(mask: Mask) -> tuple[Mask, Mask]:
    """(in the mask for certain, in it but perhaps not)."""
    from cv2 import DIST_L2, dilate, distanceTransform

    depth_px = distanceTransform(mask.astype(np.uint8), DIST_L2, 5)
    size = 2 * REACH_PX + 1
    deepest_px = dilate(depth_px, np.ones((size, size), np.uint8))
    sure = mask & (depth_px >= np.minimum(REACH_PX + 1.0, deepest_px) - 1e-3)
    return np.asarray(sure), np.asarray(mask & ~sure)


def _nearness(rgb: Picture, sides: UInt8[np.ndarray, "height width"], places: Int64[np.ndarray, " n"]) -> Float32[np.ndarray, " n"]:
    from mrbokeh.compositing._rim_colours_numba import nearness

    found = np.zeros((len(places), 2), np.float32)
    with workers(len(places) * 100) as pool:
        in_bands(pool, len(places), _BAND_PLACES, lambda first, end: nearness(found, places, rgb, sides, _WINDOW_PX, first, end))
    return np.where(found[:, 1] > _LEAST_APART, found[:, 0], np.float32(np.nan)).astype(np.float32)
