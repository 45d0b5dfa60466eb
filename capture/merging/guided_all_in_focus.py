"""Second-pass all-in-focus picture, guided by a depth that does not come from focus.

Depth from focus is misled where blur itself has structure: the discs of lights, the blurred rims of near objects. What it
picks there puts rings and halos into the picture. With another depth every pixel is taken from the slices in which its own
surface is sharp, and what nearer surfaces blurred over it is taken off.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32

from capture.merging.nearer_blur import nearer_blur
from capture.merging.slice_optics import SliceOptics

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]

# Slices in which a surface is blurred by less than this are averaged, with weights that end here.
BLENDED_COC_PX = 1.5
# Slices blurred by more than this are candidates only where nothing else is left.
LARGEST_COC_PX = 12.0
# What is taken off a pixel is known to a share of itself; blocked by all of the pupil it costs as much as this blur.
BLOCKED_COST_PX = 6.0
LARGEST_BLOCKED_SHARE = 0.8


def all_in_focus_from_depth(
    slices: Callable[[], Iterable[Rgb]],
    depth_m: Float[np.ndarray, "height width"],
    optics: SliceOptics,
    sharp: Rgb,
    valid: Callable[[int], Mask] | None = None,
) -> Rgb:
    """All-in-focus picture of registered slices, guided by depth along the axis in metres (inf allowed).

    slices: gives a fresh pass over them, one held at a time. sharp: first-pass all-in-focus picture: near surfaces are
    taken from it. valid: where slice i has data.
    """
    dioptres = (1.0 / np.asarray(depth_m, np.float64)).astype(np.float32)
    picture = _Picture.blank(dioptres.shape)
    for index, rgb in enumerate(slices()):
        coc_px = np.abs(optics.coc_px(index, dioptres))
        wanted = coc_px < LARGEST_COC_PX
        nearer = nearer_blur(index, dioptres, sharp, optics, wanted)
        blocked = np.minimum(nearer.share, LARGEST_BLOCKED_SHARE)[..., None]
        cost = coc_px + BLOCKED_COST_PX * nearer.share
        if valid is not None:
            cost = np.where(valid(index), cost, np.float32(1e3) + coc_px)
        picture.add(np.maximum(rgb - nearer.light, 0.0) / (1.0 - blocked), cost)
    return picture.result()


@dataclass
class _Picture:
    """A picture under construction: the mean of all good slices, and the best where none is good."""

    blended: Rgb
    weight: Plane
    best: Rgb
    least_cost: Plane

    @classmethod
    def blank(cls, shape: tuple[int, ...]) -> "_Picture":
        return cls(
            np.zeros((*shape, 3), np.float32),
            np.zeros(shape, np.float32),
            np.zeros((*shape, 3), np.float32),
            np.full(shape, np.inf, np.float32),
        )

    def add(self, rgb: Rgb, cost: Plane) -> None:
        weight = np.maximum(1.0 - cost / np.float32(BLENDED_COC_PX), 0.0)
        self.blended += weight[..., None] * rgb
        self.weight += weight
        better = cost < self.least_cost
        self.best[better] = rgb[better]
        self.least_cost[better] = cost[better]

    def result(self) -> Rgb:
        good = self.weight > 0.05
        return np.where(good[..., None], self.blended / np.maximum(self.weight, 0.05)[..., None], self.best)
