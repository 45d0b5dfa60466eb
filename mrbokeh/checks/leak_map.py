"""Leaks: pixels of the photograph that were changed although no virtual light reaches them."""

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32, Int32

from mrbokeh.checks.checked_picture import SHADOW, SHARP, VIRTUAL, CheckedPicture
from mrbokeh.checks.findings import CheckReport, Finding
from mrbokeh.images.layer import Layer
from mrbokeh.images.picture_codec import write_stored
from mrbokeh.optics.lens import Lens

Mask = Bool[np.ndarray, "height width"]

_RADII = 12
_SPARE_PX = 1.5


def reach(picture: CheckedPicture, lens: Lens | None) -> Mask | None:
    """(H, W) where virtual light may arrive or take the photograph's away; None where nobody knows.

    From the blurred layers where the picture has them, else from the sharp layer and the circle of confusion of its lens.
    """
    blurred = [picture.layers[name] for name in (VIRTUAL, SHADOW) if name in picture.layers]
    if blurred:
        return np.logical_or.reduce([(each.alpha != 0) | (each.rgb != 0).any(axis=2) for each in blurred])
    sharp = picture.layers.get(SHARP)
    return None if sharp is None or lens is None else reach_of_sharp(sharp, lens)


def reach_of_sharp(layer: Layer, lens: Lens) -> Mask:
    """Every lit pixel grown by the radius of its circle of confusion, in a few steps of radius that err on the large side."""
    import cv2

    lit = (layer.alpha > 0) | (layer.rgb != 0).any(axis=2)
    radius_px = np.where(lit, np.abs(lens.coc_px(layer.depth_m, layer.width_px)) / 2.0 + _SPARE_PX, 0.0)
    reached = lit.copy()
    steps = np.unique(np.quantile(radius_px[lit], np.linspace(0, 1, _RADII + 1)[1:])) if lit.any() else np.empty(0)
    nearer = -1.0
    for step in steps:
        members = lit & (radius_px > nearer) & (radius_px <= step)
        nearer = step
        if members.any():
            reached |= cv2.distanceTransform((~members).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_PRECISE) <= step
    return reached


@dataclass
class LeakMap:
    """Counts, over all pictures, how often each pixel was changed out of reach."""

    storage_step: float | None = None
    counts: Int32[np.ndarray, "height width"] | None = field(default=None)

    def add(self, report: CheckReport, picture: CheckedPicture, plate_rgb: Float32[np.ndarray, "height width 3"], reached: Mask) -> None:
        storage = picture.storage if self.storage_step is None else replace(picture.storage, step=self.storage_step)
        leaked = storage.changed(picture.rgb, plate_rgb) & ~reached
        self.counts = leaked.astype(np.int32) if self.counts is None else self.counts + leaked
        share = float(leaked.mean())
        report.raise_measure("largest share of pixels that leaked", share)
        if leaked.any():
            y, x = np.argwhere(leaked)[0]
            text = f"{int(leaked.sum())} pixels outside the reach of virtual light were changed, the first at {x},{y}"
            report.findings.append(Finding("leak", picture.name, text, share, 0.0))

    def write(self, path: Path) -> bool:
        """A PNG with the leaked pixels in white, darker where in few pictures only. False where there are none."""
        if self.counts is None or not self.counts.any():
            return False
        shade = np.where(self.counts > 0, np.maximum(64, 255 * self.counts // self.counts.max()), 0).astype(np.uint8)
        write_stored(path, shade)
        return True
