"""The blur of nearer surfaces over a pixel: how much of the pupil they block, and the light they put in its place.

Beside the edge of a near object, in the slice in which the far surface is sharp, the object's own blur lies over that surface:
    slice = near light + (1 - blocked share of the pupil) * far light.
With depth and a sharp picture of the near surface both terms are known, and the far light can be had back (as layered
renderers composite, here solved for the layer behind).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from jaxtyping import Bool, Float32

from capture.merging.slice_optics import SliceOptics
from mrbokeh.optics.aperture import Aperture

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]

KERNELS_PER_PX = 2
# A surface counts as nearer where its blur differs by this much: less is the slope of one surface.
LEAST_STEP_COC_PX = 0.5
# Gathering costs the square of the blur: from this diameter on the grid is coarser.
LARGEST_GATHERED_PX = 16.0


@dataclass(frozen=True)
class NearerBlur:
    """share (H, W): of the pupil, blocked by nearer surfaces, 0 to 1. light (H, W, 3): what they put there instead."""

    share: Plane
    light: Rgb


def nearer_blur(index: int, dioptres: Plane, sharp: Rgb, optics: SliceOptics, wanted: Bool[np.ndarray, "height width"]) -> NearerBlur:
    """What nearer surfaces put over the wanted pixels of slice `index`; 0 elsewhere.

    sharp: the all-in-focus picture as far as it is known; only its near surfaces count. Large blur is smooth, so it is
    gathered on a coarser grid.
    """
    import cv2

    shrink = int(np.ceil(np.abs(optics.coc_px(index, dioptres)).max() / LARGEST_GATHERED_PX))
    if shrink <= 1:
        return _gathered(index, dioptres, sharp, optics, wanted)
    size, small = dioptres.shape[::-1], (-(-dioptres.shape[1] // shrink), -(-dioptres.shape[0] // shrink))
    coarse = _gathered(
        index,
        cv2.resize(dioptres, small, interpolation=cv2.INTER_NEAREST),
        cv2.resize(sharp, small, interpolation=cv2.INTER_AREA),
        optics.reduced(shrink),
        cv2.resize(wanted.astype(np.float32), small, interpolation=cv2.INTER_AREA) > 0,
    )
    share, light = (cv2.resize(each, size, interpolation=cv2.INTER_LINEAR) for each in (coarse.share, coarse.light))
    return NearerBlur(share * wanted, light * wanted[..., None])


def _gathered(index: int, dioptres: Plane, sharp: Rgb, optics: SliceOptics, wanted: Bool[np.ndarray, "height width"]) -> NearerBlur:
    from capture.merging._nearer_blur_numba import gather_nearer

    coc_px, least_step = optics.coc_px(index, dioptres), LEAST_STEP_COC_PX / optics.px_per_dioptre[index]
    share, light = np.zeros(dioptres.shape, np.float32), np.zeros(sharp.shape, np.float32)
    reached = wanted & _reached(coc_px, dioptres, least_step)
    if reached.any():
        kernels = pupil_pictures(optics.aperture, int(np.ceil(np.abs(coc_px).max() * KERNELS_PER_PX)) + 1)
        focus, growth = optics.focus_dioptres[index], optics.px_per_dioptre[index]
        gather_nearer(dioptres, sharp, focus, growth, kernels, float(KERNELS_PER_PX), reached, least_step, share, light)
    return NearerBlur(np.minimum(share, 1.0), light)


@lru_cache(maxsize=4)
def pupil_pictures(aperture: Aperture, count: int) -> Float32[np.ndarray, "count size size"]:
    """The circle of confusion at diameters 0, 1, 2, ... / KERNELS_PER_PX pixels, each in the middle of a square and of sum 1."""
    pictures = [aperture.rasterize(index / KERNELS_PER_PX).kernel for index in range(count)]
    size = max(len(picture) for picture in pictures)
    stacked = np.zeros((count, size, size), np.float32)
    for result, picture in zip(stacked, pictures, strict=True):
        margin = (size - len(picture)) // 2
        result[margin : margin + len(picture), margin : margin + len(picture)] = picture
    return stacked


def _reached(coc_px: Plane, dioptres: Plane, least_step: float) -> Bool[np.ndarray, "height width"]:
    """Pixels that some nearer surface may reach: within the largest blur of anything, there is something nearer."""
    import cv2

    reach_px = int(np.ceil(0.5 * np.abs(coc_px).max())) + 1
    nearest = cv2.dilate(dioptres, np.ones((2 * reach_px + 1, 1), np.uint8))
    nearest = cv2.dilate(nearest, np.ones((1, 2 * reach_px + 1), np.uint8))
    return nearest > dioptres + np.float32(least_step)
