"""The worst places of a merged picture: crops at 100 % of it and of the slices that it was made from."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from capture.report.neighbour_places import NeighbourPlace
from capture.report.picture_evidence import PictureLook
from capture.report.pictures import Shown, crops_shown
from capture.report.stack_rules import LARGEST_FLAT, LARGEST_LOST, LARGEST_TOP, LIGHT, PLACES, SEAMS, SHARP
from capture.stacks.block_detail import BLOCK_PX
from mrbokeh.stacks.focal_stack import FocalStack

Rgb = Float32[np.ndarray, "height width 3"]
Crop = Float32[np.ndarray, "crop_height crop_width 3"]
Plane = Float32[np.ndarray, "height width"]

CROP_PX = 160
MOST_PLACES = 3


@dataclass(frozen=True)
class Place:
    """A block to look at. gate: whose. at_px: x, y of its first pixel. text: what is wrong. slices: index, and what it is to the place."""

    gate: str
    at_px: tuple[int, int]
    text: str
    slices: tuple[tuple[int, str], ...]

    @property
    def caption(self) -> str:
        return f"x {self.at_px[0]}, y {self.at_px[1]}: {self.text}"


@dataclass(frozen=True)
class ShownPlace:
    """A place and its crops."""

    place: Place
    pictures: tuple[Shown, ...]


def worst_places(look: PictureLook, focus_index: Plane, pairs: Sequence[NeighbourPlace]) -> list[Place]:
    """Up to three places for a gate that fails, one where none does. focus_index: which slice each pixel was taken from."""
    return [*_lost(look), *_seams(look, focus_index), *_brightest(look), *_farthest_apart(pairs)]


def shown_places(stack: FocalStack, picture: Rgb, places: Sequence[Place]) -> list[ShownPlace]:
    """Crops of the all-in-focus picture and of the slices, each of which is read once."""
    cuts: dict[tuple[int, int], Crop] = {}
    for index in sorted({index for place in places for index, _ in place.slices}):
        rgb = stack.slice_rgb(index)
        for number, place in enumerate(places):
            cuts[number, index] = _cut(rgb, place.at_px)[0]
    shown = []
    for number, place in enumerate(places):
        crop, inside_px = _cut(picture, place.at_px)
        named = [("all in focus", crop), *((name, cuts[number, index]) for index, name in place.slices)]
        pictures = crops_shown(named, (*inside_px, BLOCK_PX), enhance=place.gate == SEAMS.name, overlay=place.gate == PLACES.name)
        shown.append(ShownPlace(place, tuple(pictures)))
    return shown


def _lost(look: PictureLook) -> list[Place]:
    """Find blocks by the detail that is missing, lost ones first."""
    sharpness, sharpest = look.sharpness, look.sharpest
    if sharpness is None or not sharpest.textured.any():
        return []
    missing = np.where(sharpest.textured, sharpest.detail * (1.0 - sharpness.kept), -np.inf)
    places = []
    for row, column in _spread_out(np.where(sharpness.lost_blocks, missing + 1e3, missing), sharpness.lost > LARGEST_LOST):
        index, kept = int(sharpest.index[row, column]), float(sharpness.kept[row, column])
        slices = ((index, f"slice {index}, the sharpest here"),)
        places.append(Place(SHARP.name, look.corner_px(row, column), f"{kept:.0%} of the detail of slice {index}", slices))
    return places


def _seams(look: PictureLook, focus_index: Plane) -> list[Place]:
    """Find blocks by the detail that is too much."""
    sharpness, sharpest = look.sharpness, look.sharpest
    if sharpness is None or look.findings.flat is None:
        return []
    added = np.where(sharpest.flat, sharpest.detail * (sharpness.kept - 1.0), -np.inf)
    places = []
    for row, column in _spread_out(added, sharpness.flat > LARGEST_FLAT):
        at_px, index = look.corner_px(row, column), int(sharpest.index[row, column])
        slices = tuple((side, f"slice {side}, merged here") for side in _merged_from(focus_index, at_px))
        text = f"{float(sharpness.kept[row, column]):.2f} times the detail of slice {index}, the sharpest here"
        places.append(Place(SEAMS.name, at_px, text, slices))
    return places


def _brightest(look: PictureLook) -> list[Place]:
    """The largest values of the picture, beside the slice that is brightest there."""
    too_bright = look.findings.top_ratio > LARGEST_TOP
    places = []
    for row, column in _spread_out(look.brightest, too_bright):
        value, of_slices = float(look.brightest[row, column]), float(look.slices_brightest[row, column])
        index = int(look.brightest_slice[row, column])
        slices = ((index, f"slice {index}, the brightest here"),)
        text = f"{value:.3g}, where the slices reach {of_slices:.3g}"
        places.append(Place(LIGHT.name, (BLOCK_PX * column, BLOCK_PX * row), text, slices))
    return places


def _farthest_apart(pairs: Sequence[NeighbourPlace]) -> list[Place]:
    known = [each for each in pairs if each.off_px is not None]
    if not known:
        return []
    worst = max(known, key=NeighbourPlace.rank)
    names = tuple((index, f"slice {index}") for index in (worst.first, worst.first + 1))
    x, y = (max(each - BLOCK_PX // 2, 0) for each in worst.place_px)
    return [Place(PLACES.name, (x, y), f"slices {worst.first} and {worst.first + 1} lie {worst.off_px:.2f} px apart", names)]


def _spread_out(badness: Float32[np.ndarray, "rows columns"], failing: bool) -> list[tuple[int, int]]:
    """Row and column of the worst blocks, no two of them in one crop: three where the gate fails, else one."""
    left, found = badness.astype(np.float64), []
    apart = CROP_PX // BLOCK_PX
    for _ in range(MOST_PLACES if failing else 1):
        row, column = (int(each) for each in np.unravel_index(int(left.argmax()), left.shape))
        if not left[row, column] > -np.inf:
            break
        found.append((row, column))
        left[max(row - apart, 0) : row + apart + 1, max(column - apart, 0) : column + apart + 1] = -np.inf
    return found


def _merged_from(focus_index: Plane, at_px: tuple[int, int]) -> list[int]:
    """The two slices that most of a block and what lies around it were taken from, or the one."""
    x, y = at_px
    around = focus_index[max(y - BLOCK_PX // 2, 0) : y + 3 * BLOCK_PX // 2, max(x - BLOCK_PX // 2, 0) : x + 3 * BLOCK_PX // 2]
    indices, counts = np.unique(np.round(around).astype(int), return_counts=True)
    return sorted(int(each) for each in indices[np.argsort(-counts, kind="stable")][:2])


def _cut(rgb: Rgb, at_px: tuple[int, int]) -> tuple[Crop, tuple[int, int]]:
    """CROP_PX around a block, inside the picture, and x, y of the block in it."""
    height, width = rgb.shape[:2]
    left, top = (
        int(np.clip(corner + BLOCK_PX // 2 - CROP_PX // 2, 0, max(size - CROP_PX, 0)))
        for corner, size in zip(at_px, (width, height), strict=True)
    )
    return rgb[top : top + CROP_PX, left : left + CROP_PX].copy(), (at_px[0] - left, at_px[1] - top)
