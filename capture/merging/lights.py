"""Small bright lights in a focal stack: where they are, and in which slice each is a point.

A light out of focus draws a disc with a sharp rim that outshouts the detail behind it, so the focus energy of the pixels
around it points at the wrong slice, and the merged picture gets ghost rings. Around each light the slice is therefore
chosen by the light itself: the one in which its energy is most concentrated throws least of it on its surroundings.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import cached_property

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, UInt8

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Codes = UInt8[np.ndarray, "slices height width"]
PerLight = Float[np.ndarray, " lights"]
PerPixel = Float[np.ndarray, " pixels"]

OVER_RANGE = 0.9
TIMES_SURROUNDINGS = 5.0
WIDEST_SHARE = 0.03
CLEARLY_BRIGHTER = 0.15
LEAST_SHARE_OF_LIGHT = 0.1
# The disc of a defocused light grows at least by this factor over the stack, and lies in one slice at least below what fills the sensor.
# Print, paper and metal, which never fill it or are as large everywhere, do not.
LEAST_GROWTH = 1.5
UNSATURATED_SHARE = 0.92
# Full places whose light grows as they do (`spread_light`): above this code, so many pixels in each slice, at most so wide (a share of the
# picture), and this many times as large in several slices. Of the light that their growth would bring, this share is seen.
_FULL_CODE = 245
_LEAST_FULL_PX = 9
_WIDEST_FULL = 0.06
_LEAST_SPREAD = 1.5
_FEWEST_SPREAD = 3
_LEAST_NEW_LIGHT = 0.5
# The rim of what is full has its say this far around it.
_RIM_PX = 6


@dataclass(frozen=True)
class Lights:
    """zone (H, W): the light whose spread reaches a pixel, 0 for none; core (H, W): the lights themselves.

    sharpest: for light 1, 2, ... the index of the slice in which it is most concentrated.
    focus_index: the fractional index at which each is in focus, from the growth of its disc.
    areas_px: how many pixels each covers in each slice.
    """

    zone: Int[np.ndarray, "height width"]
    core: Bool[np.ndarray, "height width"]
    sharpest: Int[np.ndarray, " lights"]
    focus_index: Float[np.ndarray, " lights"]
    areas_px: Float[np.ndarray, "slices lights"]

    def __len__(self) -> int:
        return len(self.sharpest)

    @cached_property
    def _boxes(self) -> list[tuple[slice, slice]]:
        members = np.flatnonzero(self.zone)
        numbers = self.zone.ravel()[members]
        order = np.argsort(numbers, kind="stable")
        starts = np.searchsorted(numbers[order], np.arange(1, len(self) + 1))
        sides = []
        for along in np.divmod(members[order], self.zone.shape[1]):
            sides.append(
                [slice(int(a), int(b) + 1) for a, b in zip(*(f.reduceat(along, starts) for f in (np.minimum, np.maximum)), strict=True)]
            )
        return list(zip(*sides, strict=True))

    def box(self, light: int, margin_px: int = 0) -> tuple[slice, slice]:
        """Return the rows and columns of a light's zone with a margin, as far as the picture goes."""
        sides = zip(self._boxes[light], self.zone.shape, strict=True)
        rows, columns = (slice(max(each.start - margin_px, 0), min(each.stop + margin_px, size)) for each, size in sides)
        return rows, columns

    def only(self, kept: Bool[np.ndarray, " lights"]) -> "Lights":
        """Return some of the lights; the others are no lights any more."""
        number = np.concatenate([[0], np.where(kept, np.cumsum(kept), 0)]).astype(self.zone.dtype)
        zone = number[self.zone]
        return Lights(
            zone=zone,
            core=self.core & (zone > 0),
            sharpest=self.sharpest[kept],
            focus_index=self.focus_index[kept],
            areas_px=self.areas_px[:, kept],
        )

    def slice_index(self) -> Int[np.ndarray, "height width"]:
        """(H, W): the sharpest slice of the light that reaches a pixel, -1 where none does."""
        return np.concatenate([[-1], self.sharpest]).astype(np.int64)[self.zone]


@dataclass
class Extremes:
    """The darkest and the brightest that each pixel gets in any slice, gathered while the slices pass by."""

    darkest: Plane | None = None
    brightest: Plane | None = None
    _channels: list[Plane] = field(default_factory=list)

    def watching(self, slices: Iterable[Rgb]) -> Iterator[Rgb]:
        """The slices as they come; each is looked at."""
        for rgb in slices:
            plane = _brightness(rgb, self._channels)
            if self.darkest is None or self.brightest is None:
                self.darkest, self.brightest = plane.copy(), plane.copy()
            else:
                cv2.min(self.darkest, plane, dst=self.darkest)
                cv2.max(self.brightest, plane, dst=self.brightest)
            yield rgb


def find_lights(slices: Callable[[], Iterable[Rgb]], extremes: Extremes | None = None) -> Lights:
    """Lights of registered slices. slices: gives a fresh pass over them, one slice held at a time.

    extremes: what an earlier pass has gathered. Up to two passes are made, the second only where there are lights.
    """
    if extremes is None:
        extremes = Extremes()
        for _ in extremes.watching(slices()):
            pass
    darkest, brightest = extremes.darkest, extremes.brightest
    assert darkest is not None and brightest is not None, "a stack has slices"
    reach_px = int(np.ceil(WIDEST_SHARE * darkest.shape[1]))
    surroundings = cv2.blur(darkest, (2 * reach_px + 1, 2 * reach_px + 1))
    spots = (brightest > OVER_RANGE) & (brightest > TIMES_SURROUNDINGS * surroundings)
    if not spots.any():
        return no_lights(darkest.shape)
    nearest, distance_px = _nearest_spot(spots)
    near = np.where(distance_px <= reach_px, nearest, 0)
    members = np.flatnonzero(near)
    spreads = _Spreads(near.ravel()[members], (surroundings + CLEARLY_BRIGHTER).ravel()[members])
    channels: list[Plane] = []
    for rgb in slices():
        spreads.add(_brightness(rgb, channels).take(members))
    return _lights(spreads, near, distance_px, reach_px)


def _lights(spreads: "_Spreads", near: Int[np.ndarray, "height width"], distance_px: Plane, reach_px: int) -> Lights:
    """The zone of each light is a little larger than its widest disc; its core is what is over range where it is sharpest."""
    light, areas_px, peaks = (np.array(each) for each in zip(*spreads.rows, strict=True))
    # Far out of focus a light drowns in its surroundings; in focus most of it may be lost, but its peak is not.
    seen = (light >= LEAST_SHARE_OF_LIGHT * light.max(axis=0)) | (peaks > OVER_RANGE)
    sharpest = np.where(seen, areas_px, np.inf).argmin(axis=0)
    radius_px = np.concatenate([[0.0], 1.3 * np.sqrt(np.where(seen, areas_px, 0.0).max(axis=0) / np.pi) + 2.0])
    zone = np.where(distance_px <= np.minimum(radius_px, reach_px)[near], near, 0)
    core, members = np.zeros(zone.shape, bool), np.flatnonzero(near)
    owner = np.concatenate([[-1], sharpest])[zone].ravel()[members]
    for index in range(len(areas_px)):
        mine = owner == index
        core.ravel()[members[mine]] = spreads.over_range(index)[mine]
    found = Lights(zone=zone, core=core, sharpest=sharpest, focus_index=_between_slices(areas_px, seen, sharpest), areas_px=areas_px)
    return found.only(_grows(areas_px, peaks, seen))


def _grows(areas_px: np.ndarray, peaks: np.ndarray, seen: np.ndarray) -> Bool[np.ndarray, " lights"]:
    """Return which candidates (slices, lights) grow over the slices, and are below saturation in one of them."""
    holds = seen & (peaks < UNSATURATED_SHARE * peaks.max(axis=0))
    largest, least = np.where(seen, areas_px, 0.0).max(axis=0), np.where(seen, areas_px, np.inf).min(axis=0)
    return holds.any(axis=0) & (largest > LEAST_GROWTH * least)


def spread_light(codes: Codes) -> Bool[np.ndarray, "slices height width"]:
    """Return where slices are full, or beside it, because blur has spread a light there that the sensor could not hold.

    codes: the square root of their light, 255 at white. Blur conserves light: a place that is full in all slices and brings more light
    where it is larger was clipped where it is small, and is sharpest there. White print brings no more light out of focus.
    """
    full = codes >= _FULL_CODE
    result = np.zeros(codes.shape, bool)
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(np.asarray(full.any(axis=0), np.uint8), connectivity=8)
    for number, (x, y, width, height, area) in enumerate(boxes[1:].tolist(), 1):
        if area <= _LEAST_SPREAD * _LEAST_FULL_PX or max(width, height) > _WIDEST_FULL * codes.shape[2]:
            continue
        around = max(width, height) // 2 + _RIM_PX
        box = (slice(max(y - around, 0), y + height + around), slice(max(x - around, 0), x + width + around))
        mine, alone = full[:, *box] & (labels[box] == number), (labels[box] == number) | (labels[box] == 0)
        areas = mine.sum(axis=(1, 2))
        if areas.min() < _LEAST_FULL_PX:
            continue
        sums = ((codes[:, *box] / np.float32(255.0)) ** 2 * alone).sum(axis=(1, 2))
        least = int(sums.argmin())
        grown = areas - areas[least]
        spread = (areas > _LEAST_SPREAD * areas[least]) & (grown > _LEAST_FULL_PX) & (sums - sums[least] > _LEAST_NEW_LIGHT * grown)
        if np.count_nonzero(spread) >= _FEWEST_SPREAD:
            rim = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * _RIM_PX + 1,) * 2)
            for index in np.flatnonzero(spread):
                result[index, *box] |= cv2.dilate(mine[index].astype(np.uint8), rim) > 0
    return result


def no_lights(shape: tuple[int, ...]) -> Lights:
    nothing = np.zeros(0, np.int64)
    return Lights(
        zone=np.zeros(shape, np.int64),
        core=np.zeros(shape, bool),
        sharpest=nothing,
        focus_index=nothing.astype(np.float64),
        areas_px=np.zeros((0, 0)),
    )


def _between_slices(areas_px: np.ndarray, seen: np.ndarray, sharpest: Int[np.ndarray, " lights"]) -> PerLight:
    """Return the index at which each light is in focus.

    The diameter of its disc grows evenly with the distance from there, so the area is a parabola of the index. Fitted
    to the slices within two of the sharpest one; kept within half a step of it.
    """
    result = sharpest.astype(np.float64)
    for light, index in enumerate(sharpest):
        near = np.flatnonzero(seen[:, light] & (np.abs(np.arange(len(seen)) - index) <= 2))
        if len(near) >= 4:
            curvature, slope, _ = np.polyfit(near, areas_px[near, light], 2)
            if curvature > 0:
                result[light] = np.clip(-slope / (2.0 * curvature), index - 0.5, index + 0.5)
    return result


def _brightness(rgb: Rgb, channels: list[Plane]) -> Plane:
    """The brightest channel: coloured lights count too. channels: the planes of the picture before, which are written over."""
    channels[:] = cv2.split(rgb, channels or None)
    red, green, blue = channels
    return cv2.max(cv2.max(red, green, dst=red), blue, dst=red)


def _nearest_spot(spots: Bool[np.ndarray, "height width"]) -> tuple[Int[np.ndarray, "height width"], Float32[np.ndarray, "height width"]]:
    """(number of the nearest spot, distance to it in pixels); there is at least one spot."""
    _, labels = cv2.connectedComponents(spots.astype(np.uint8), connectivity=8)
    distance_px, cells = cv2.distanceTransformWithLabels(
        (~spots).astype(np.uint8), cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_CCOMP
    )
    number_of_cell = np.zeros(int(cells.max()) + 1, labels.dtype)
    number_of_cell[cells[spots]] = labels[spots]
    return number_of_cell[cells], distance_px


class _Spreads:
    """How far each light is spread in each slice, and which pixels near lights are over range there.

    numbers: which light each pixel is near, from 1. floor: above this brightness it is light.
    """

    def __init__(self, numbers: Int[np.ndarray, " pixels"], floor: PerPixel) -> None:
        self.numbers, self.floor, self.count = numbers, floor, int(numbers.max())
        self._order = np.argsort(numbers, kind="stable")
        self._present, self._starts = np.unique(numbers[self._order], return_index=True)
        self.rows: list[tuple[PerLight, PerLight, PerLight]] = []
        self._over: list[UInt8[np.ndarray, " packed"]] = []

    def add(self, brightness: PerPixel) -> None:
        """For each light (how much is seen of it, over how many pixels, its peak); the area of an even disc is (sum)^2 / sum of squares."""
        excess = np.maximum(brightness - self.floor, 0.0)
        total = np.bincount(self.numbers, excess, self.count + 1)[1:]
        squares = np.bincount(self.numbers, excess * excess, self.count + 1)[1:]
        peaks = np.zeros(self.count)
        peaks[self._present - 1] = np.maximum.reduceat(brightness[self._order], self._starts)
        self.rows.append((total, total**2 / np.maximum(squares, 1e-12), peaks))
        self._over.append(np.packbits(brightness > OVER_RANGE))

    def over_range(self, index: int) -> Bool[np.ndarray, " pixels"]:
        return np.unpackbits(self._over[index], count=len(self.numbers)).view(bool)
