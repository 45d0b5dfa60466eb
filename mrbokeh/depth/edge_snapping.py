"""Depth edges without pixels that float between near and far: each pixel beside an edge gets the depth of one of its two sides.

Depth maps of phones and networks are small and soft. Blurred as they are, the soft rim becomes a ghost surface between the two that
are there. Which side a pixel is on, the photograph tells (guided filter); how deep that side is, its settled pixels tell.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.depth.guided_filter import guided_upsampling

Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]

LEAST_JUMP = 0.05
"""Of the range of the map in dioptres: what rises by less within a few pixels is a surface."""
EPSILON = 1e-4
"""Variance of the root of light in [0, 1] below which the photograph tells nothing."""
_LARGEST_SIDE_PX = 1536
_SETTLED = 0.05
_SLANTED = 2.0


@dataclass(frozen=True)
class EdgeSides:
    """at_edge: (H, W) pixels near a jump. near, far: (H, W) dioptres of its two sides, which mean something at edges only."""

    at_edge: Mask
    near: Plane
    far: Plane


def refined_dioptres(
    dioptres: Plane, photo_rgb: Float32[np.ndarray, "rows columns 3"], edge_px: int = 3, least_jump: float = LEAST_JUMP
) -> Float32[np.ndarray, "rows columns"]:
    """A soft map (h, w) at the size of its photograph (H, W, 3; linear), with hard edges where the photograph has them.

    edge_px: how far, in pixels of the map, its edges may be soft or misplaced.
    """
    import cv2

    size = photo_rgb.shape[1::-1]
    # A root is as good a guide as the sRGB curve, and 30 times quicker.
    guide = np.sqrt(np.clip(photo_rgb, 0.0, 1.0))
    plain = cv2.resize(dioptres, size, interpolation=cv2.INTER_LINEAR)
    coarse = _at_most(dioptres, _LARGEST_SIDE_PX)
    followed = guided_upsampling(coarse, guide, edge_px, EPSILON)
    sides = edge_sides(coarse, edge_px, least_jump * float(np.ptp(coarse)))
    at_edge = cv2.resize(sides.at_edge.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
    near, far = (cv2.resize(each, size, interpolation=cv2.INTER_NEAREST) for each in (sides.near, sides.far))
    is_near = cv2.blur((followed > 0.5 * (near + far)).astype(np.float32), (3, 3)) > 0.5
    return np.where(at_edge, np.where(is_near, near, far), plain).astype(np.float32)


def _at_most(dioptres: Plane, side_px: int) -> Plane:
    import cv2

    shrink = side_px / max(dioptres.shape)
    size = (round(dioptres.shape[1] * shrink), round(dioptres.shape[0] * shrink))
    return dioptres if shrink >= 1.0 else cv2.resize(dioptres, size, interpolation=cv2.INTER_NEAREST)


def edge_sides(dioptres: Plane, edge_px: int, least_jump: float) -> EdgeSides:
    """An edge is where the map jumps within edge_px and hardly rises farther out; what goes on rising is a slanted surface.

    The sides come from the nearest settled pixels: those that are as near or as far as anything around them, so that a wire one
    pixel wide is one too, and a pixel of the soft rim is not.
    """
    window = 2 * edge_px + 1
    low, high = _lowest(dioptres, window), _highest(dioptres, window)
    jump = high - low
    wide = _highest(dioptres, 3 * window) - _lowest(dioptres, 3 * window)
    at_edge = (jump > least_jump) & (wide < _SLANTED * jump)
    slack = _SETTLED * jump
    settled_high = (dioptres >= _highest(dioptres, 3) - slack) & (dioptres > high - 0.5 * jump)
    settled_low = (dioptres <= _lowest(dioptres, 3) + slack) & (dioptres < low + 0.5 * jump)
    near, has_near = _nearest(dioptres, settled_high & at_edge, 2 * edge_px)
    far, has_far = _nearest(dioptres, settled_low & at_edge, 2 * edge_px)
    return EdgeSides(at_edge & has_near & has_far, near, far)


def _nearest(values: Plane, known: Mask, reach_px: int) -> tuple[Plane, Mask]:
    """The value of the nearest known pixel, and where that is within reach."""
    from scipy.ndimage import distance_transform_edt

    if not known.any():
        return values, known
    distance, (rows, columns) = distance_transform_edt(~known, return_indices=True)
    return values[rows, columns], distance <= reach_px


def _lowest(values: Plane, window: int) -> Plane:
    import cv2

    return cv2.erode(values, np.ones((window, window), np.uint8))


def _highest(values: Plane, window: int) -> Plane:
    import cv2

    return cv2.dilate(values, np.ones((window, window), np.uint8))
