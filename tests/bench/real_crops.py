"""Crops at 100 % of the places where an all-in-focus picture does worst, beside the sharpest slice and the peers."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float32

from capture.report.picture_sharpness import Blocks, SharpestSlices, Sharpness, border_blocks
from capture.stacks.slice_looks import BLOCK_PX
from mrbokeh.images.color import display_rgb8
from tests.bench.real_stack import Rgb

CROP_PX = 7 * BLOCK_PX
APART_BLOCKS = 6
LOST_PLACES, FLAT_PLACES = 3, 2
JPEG_QUALITY = 92


class Place(NamedTuple):
    """A pixel (x, y) and what is wrong there. sharpest: the slice that is sharpest there."""

    x: int
    y: int
    sharpest: int
    said: str


@dataclass(frozen=True)
class Crop:
    """name: what the panel shows. file: in the folder of the crops."""

    name: str
    file: str


def worst_places(sharpest: SharpestSlices, measured: Sharpness, picture: Rgb, top_bar: float) -> list[Place]:
    """The lost blocks that keep least (one that is not lost where none is), the flat blocks that are raised most, the largest value."""
    at = _Blocks(sharpest, border_blocks(picture.shape))
    textured, raised = (np.where(which, measured.kept, np.nan) for which in (sharpest.textured, sharpest.flat))
    lost = [at.place(block, f"keeps {measured.kept[block]:.2f}") for block in _apart(textured, LOST_PLACES)]
    places = lost[: max(1, sum(bool(measured.lost_blocks[block]) for block in _apart(textured, LOST_PLACES)))]
    places += [at.place(block, f"flat, raised to {measured.kept[block]:.2f}") for block in _apart(-raised, FLAT_PLACES)]
    if measured.top > top_bar:
        y, x = np.unravel_index(int(picture.max(axis=2).argmax()), picture.shape[:2])
        places.append(at.pixel(int(x), int(y), f"largest value, {picture[y, x].max():.1f} where slices reach {sharpest.largest:.2f}"))
    return places


@dataclass(frozen=True)
class _Blocks:
    sharpest: SharpestSlices
    border: int

    def place(self, block: tuple[int, int], said: str) -> Place:
        y, x = ((each + self.border) * BLOCK_PX + BLOCK_PX // 2 for each in block)
        return Place(x, y, int(self.sharpest.index[block]), said)

    def pixel(self, x: int, y: int, said: str) -> Place:
        rows, columns = self.sharpest.index.shape
        block = (min(max(y // BLOCK_PX - self.border, 0), rows - 1), min(max(x // BLOCK_PX - self.border, 0), columns - 1))
        return Place(x, y, int(self.sharpest.index[block]), said)


def _apart(values: Float32[np.ndarray, "rows columns"] | Blocks, count: int) -> list[tuple[int, int]]:
    """The blocks with the smallest values, no two near one another; NaN is none."""
    left = values.astype(np.float64)
    found: list[tuple[int, int]] = []
    while len(found) < count and np.isfinite(left).any():
        row, column = (int(each) for each in np.unravel_index(int(np.nanargmin(left)), left.shape))
        found.append((row, column))
        left[max(row - APART_BLOCKS, 0) : row + APART_BLOCKS + 1, max(column - APART_BLOCKS, 0) : column + APART_BLOCKS + 1] = np.nan
    return found


def write_crops(folder: Path, stem: str, place: Place, slice_at: Callable[[int], Rgb], pictures: Mapping[str, Rgb]) -> list[Crop]:
    """The sharpest slice and each picture, cut out around a place as JPEG files."""
    folder.mkdir(parents=True, exist_ok=True)

    def panels() -> Iterator[tuple[str, Rgb]]:
        yield f"sharpest slice ({place.sharpest})", slice_at(place.sharpest)
        yield from pictures.items()

    crops = []
    for number, (name, rgb) in enumerate(panels()):
        file = f"{stem}_{number}.jpg"
        codes = np.ascontiguousarray(display_rgb8(_cut(rgb, place))[..., ::-1])
        quality = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
        cv2.imwrite(str(folder / file), codes, quality)
        crops.append(Crop(name, file))
    return crops


def _cut(rgb: Rgb, place: Place) -> Rgb:
    left, upper = (
        min(max(at - CROP_PX // 2, 0), max(side - CROP_PX, 0)) for at, side in ((place.x, rgb.shape[1]), (place.y, rgb.shape[0]))
    )
    return rgb[upper : upper + CROP_PX, left : left + CROP_PX]
