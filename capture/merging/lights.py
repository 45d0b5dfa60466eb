"""Small bright lights in a focal stack: where they are, and in which slice each is a point.

A light out of focus draws a disc with a sharp rim that outshouts the detail behind it, so the focus energy of the pixels
around it points at the wrong slice, and the merged picture gets ghost rings. Around each light the slice is therefore
chosen by the light itself: the one in which its energy is most concentrated throws least of it on its surroundings.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
PerLight = Float[np.ndarray, " lights"]

OVER_RANGE = 0.9
TIMES_SURROUNDINGS = 5.0
WIDEST_SHARE = 0.03
CLEARLY_BRIGHTER = 0.15
LEAST_SHARE_OF_LIGHT = 0.1


@dataclass(frozen=True)
class Lights:
    """zone (H, W): the light whose spread reaches a pixel, 0 for none; core (H, W): the lights themselves.

    sharpest: for light 1, 2, ... the index of the slice in which it is most concentrated.
    focus_index: the fractional index at which each is in focus, from the growth of its disc.
    widest: the slice in which each is spread widest and still seen.
    """

    zone: Int[np.ndarray, "height width"]
    core: Bool[np.ndarray, "height width"]
    sharpest: Int[np.ndarray, " lights"]
    focus_index: Float[np.ndarray, " lights"]
    widest: Int[np.ndarray, " lights"]

    def __len__(self) -> int:
        return len(self.sharpest)

    def slice_index(self) -> Int[np.ndarray, "height width"]:
        """(H, W): the sharpest slice of the light that reaches a pixel, -1 where none does."""
        return np.concatenate([[-1], self.sharpest]).astype(np.int64)[self.zone]


def find_lights(slices: Callable[[], Iterable[Rgb]]) -> Lights:
    """Lights of registered slices. slices: gives a fresh pass over them; three passes are made, one slice held at a time."""
    darkest, brightest = _extremes(_brightness(rgb) for rgb in slices())
    reach_px = int(np.ceil(WIDEST_SHARE * darkest.shape[1]))
    surroundings = cv2.blur(darkest, (2 * reach_px + 1, 2 * reach_px + 1))
    spots = (brightest > OVER_RANGE) & (brightest > TIMES_SURROUNDINGS * surroundings)
    nearest, distance_px = _nearest_spot(spots)
    count = int(nearest.max(initial=0))
    near = np.where(distance_px <= reach_px, nearest, 0)
    spreads = [_spread(_brightness(rgb), surroundings + CLEARLY_BRIGHTER, near, count) for rgb in slices()]
    light, areas_px, peaks = (np.array(each) for each in zip(*spreads, strict=True))
    # Far out of focus a light drowns in its surroundings; in focus most of it may be lost, but its peak is not.
    seen = (light >= LEAST_SHARE_OF_LIGHT * light.max(axis=0)) | (peaks > OVER_RANGE)
    sharpest = np.where(seen, areas_px, np.inf).argmin(axis=0)
    radius_px = np.concatenate([[0.0], 1.3 * np.sqrt(np.where(seen, areas_px, 0.0).max(axis=0) / np.pi) + 2.0])
    zone = np.where(distance_px <= np.minimum(radius_px, reach_px)[near], near, 0)
    core = np.zeros(zone.shape, bool)
    for index, rgb in enumerate(slices()):
        mine = np.concatenate([[-1], sharpest])[zone] == index
        core |= mine & (_brightness(rgb) > OVER_RANGE)
    return Lights(zone, core, sharpest, _between_slices(areas_px, seen, sharpest), np.where(seen, areas_px, -1.0).argmax(axis=0))


def _between_slices(areas_px: np.ndarray, seen: np.ndarray, sharpest: Int[np.ndarray, " lights"]) -> PerLight:
    """Where each light is in focus: the diameter grows evenly with the distance from there, so the area is a parabola of the index.

    Fitted to the slices within two of the sharpest one; kept within half a step of it.
    """
    result = sharpest.astype(np.float64)
    for light, index in enumerate(sharpest):
        near = np.flatnonzero(seen[:, light] & (np.abs(np.arange(len(seen)) - index) <= 2))
        if len(near) >= 4:
            curvature, slope, _ = np.polyfit(near, areas_px[near, light], 2)
            if curvature > 0:
                result[light] = np.clip(-slope / (2.0 * curvature), index - 0.5, index + 0.5)
    return result


def _brightness(rgb: Rgb) -> Plane:
    """The brightest channel: coloured lights count too."""
    return rgb.max(axis=2)


def _extremes(planes: Iterable[Plane]) -> tuple[Plane, Plane]:
    darkest: Plane | None = None
    for plane in planes:
        if darkest is None:
            darkest, brightest = plane.copy(), plane.copy()
        else:
            np.minimum(darkest, plane, out=darkest)
            np.maximum(brightest, plane, out=brightest)
    assert darkest is not None, "a stack has slices"
    return darkest, brightest


def _nearest_spot(spots: Bool[np.ndarray, "height width"]) -> tuple[Int[np.ndarray, "height width"], Float[np.ndarray, "height width"]]:
    """(number of the nearest spot, 0 where there is none at all; distance to it in pixels)."""
    from scipy.ndimage import distance_transform_edt, label

    labels, count = label(spots, structure=np.ones((3, 3)))
    if count == 0:
        return np.zeros(spots.shape, np.int64), np.full(spots.shape, np.inf)
    distance_px, (rows, columns) = distance_transform_edt(~spots, return_indices=True)
    return labels[rows, columns].astype(np.int64), distance_px


def _spread(
    brightness: Plane, surroundings: Plane, near: Int[np.ndarray, "height width"], count: int
) -> tuple[PerLight, PerLight, PerLight]:
    """For each light (how much is seen of it, over how many pixels, its peak); the area of an even disc is (sum)^2 / sum of squares."""
    excess = np.maximum(brightness - surroundings, 0.0)
    total = np.bincount(near.ravel(), excess.ravel(), count + 1)[1:]
    squares = np.bincount(near.ravel(), (excess * excess).ravel(), count + 1)[1:]
    peaks = np.zeros(count + 1)
    np.maximum.at(peaks, near.ravel(), brightness.ravel())
    return total, total**2 / np.maximum(squares, 1e-12), peaks[1:]
