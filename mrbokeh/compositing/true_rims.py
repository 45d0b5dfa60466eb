"""Rims of near things put where the photograph shows that they lie, for depth maps that are off by a pixel or two.

Such a rim takes far colour for near all along an edge. The photograph tells where the blurred edge lies, so proposals are put to the
test: the scene is cut in two with each, blurred anew, and compared with the photograph; around every place the one that explains it
better wins. What is proposed comes from the colours of the sharp picture (mrbokeh.compositing.rim_colours). Near things that depth
misses altogether stay missed.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float32

from mrbokeh.compositing.near_and_far import NearAndFar, continued, without_edge
from mrbokeh.compositing.plate import Plate
from mrbokeh.compositing.rim_colours import RimColours
from mrbokeh.renderers.base import Renderer

_AROUND_PX = 4.0
_PROPOSED = ((RimColours.without_rim, np.float32(0.9)), (RimColours.by_colour, np.float32(1.0)))
"""One after the other. Each wins where it leaves less than this part of the error."""
_LARGE_PX = 2_000_000
"""Above it half as many rows and columns are compared: a pixel is little there, and time is short."""
_FLOOR, _ROUND = np.float32(0.1), np.float32(1e-6)

Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class TrueRims:
    """cut: a plate's sharp scene in two. tolerance: see `Between`."""

    cut: Callable[[Plate, Mask], NearAndFar]
    renderer: Renderer
    tolerance: float

    def found(self, plate: Plate, near: Mask) -> tuple[Plate, Mask]:
        """The plate with its depth moved at rims, and what is near then. near: by the depth that it has.

        The very same where nothing better is found, or where there is no sharp picture and depth to look at.
        """
        if plate.sharp_rgb is None or plate.depth_m is None or not near.any() or near.all():
            return plate, near
        at_edge = ~without_edge(plate.depth_m, self.tolerance)
        best, error = near, None
        for propose, part in _PROPOSED:
            proposed = propose(RimColours.of(plate.sharp_rgb, best, at_edge))
            if not (proposed != best).any():
                continue
            error = self._error(plate, near, best) if error is None else error
            other = self._error(plate, near, proposed)
            better = other < part * error
            best, error = np.where(better, proposed, best), np.where(better, other, error)
        return (plate, near) if best is near else (replace(plate, depth_m=moved(plate.depth_m, near, best)), best)

    def _error(self, plate: Plate, near: Mask, proposed: Mask) -> Plane:
        """How ill the scene, cut so and blurred anew, explains the photograph around each pixel; relative to its light, squared."""
        from cv2 import GaussianBlur, resize

        assert plate.depth_m is not None
        tried, mask = replace(plate, depth_m=moved(plate.depth_m, near, proposed)), proposed
        around_px = _AROUND_PX
        if near.size > _LARGE_PX:
            tried, mask, around_px = _halved(tried), _half_of(proposed), 0.5 * _AROUND_PX
        scene = self.cut(tried, mask)
        anew = np.maximum(self.renderer.render([scene.near, scene.far], tried.lens).rgb, 0.0)
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
