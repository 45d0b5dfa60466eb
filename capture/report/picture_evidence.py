"""The all-in-focus picture beside its slices at full size, from one pass over them: what needs no lens and no focus distance."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int

from capture.report.detail import SharpestSlices, Sharpness, block_detail, border_blocks
from capture.stacks.block_detail import BLOCK_PX

Rgb = Float32[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]
Blocks = Float32[np.ndarray, "rows columns"]
AllBlocks = Float32[np.ndarray, "all_rows all_columns"]

FEWEST_FLAT = 20
"""Fewer blocks have no 95th percentile; a picture of 288 x 312 pixels has as many."""


@dataclass(frozen=True)
class PictureFindings:
    """Numbers of a picture beside its slices (see `detail.Sharpness`).

    lost: None where the picture has no textured blocks. flat: None where it has fewer than FEWEST_FLAT flat ones. top, slices_top: largest
    value of the picture and of all slices, in the RGB in which they are stored. seen_px: width and height of what was looked at.
    """

    lost: float | None
    flat: float | None
    top: float
    slices_top: float
    seen_px: tuple[int, int]

    @property
    def top_ratio(self) -> float:
        return self.top / max(self.slices_top, 1e-9)


@dataclass
class PictureEvidence:
    """Takes the slices one after the other and keeps a number or two of each block."""

    _details: list[Blocks] = field(default_factory=list)
    _brightest: list[AllBlocks] = field(default_factory=list)

    def add(self, rgb: Rgb, camera_rgb: Rgb, valid: Mask) -> None:
        """A slice at the size of its file, in Rec.709 and as it is stored; blocks in which it lacks data do not count as sharp."""
        self._details.append(block_detail(rgb, valid))
        self._brightest.append(_largest_of_blocks(camera_rgb))

    def look(self, picture: Rgb, camera_rgb: Rgb) -> "PictureLook":
        """picture, camera_rgb: all in focus, of the slices' size."""
        of_slices = np.stack(self._brightest)
        sharpest = SharpestSlices.of_details(self._details, float(of_slices.max()))
        sharpness = sharpest.measure(picture) if sharpest.detail.size else None
        return PictureLook(sharpest, sharpness, picture, _largest_of_blocks(camera_rgb), of_slices.max(axis=0), of_slices.argmax(axis=0))


@dataclass(frozen=True)
class PictureLook:
    """A picture and what its slices reach. sharpness: None where the picture is smaller than a block.

    brightest, slices_brightest, brightest_slice: the largest value of the picture in each block, border blocks included, that of all
    slices there, and whose it is.
    """

    sharpest: SharpestSlices
    sharpness: Sharpness | None
    picture: Rgb
    brightest: AllBlocks
    slices_brightest: AllBlocks
    brightest_slice: Int[np.ndarray, "all_rows all_columns"]

    @property
    def findings(self) -> PictureFindings:
        sharpness, size_px = self.sharpness, (self.picture.shape[1], self.picture.shape[0])
        lost = sharpness.lost if sharpness is not None and self.sharpest.textured.any() else None
        flat = sharpness.flat if sharpness is not None and self.sharpest.flat.sum() >= FEWEST_FLAT else None
        return PictureFindings(lost, flat, float(self.brightest.max()), self.sharpest.largest, size_px)

    def corner_px(self, row: int, column: int) -> tuple[int, int]:
        """x, y of the first pixel of a block of `sharpest`."""
        border = border_blocks(self.picture.shape)
        return (column + border) * BLOCK_PX, (row + border) * BLOCK_PX


def _largest_of_blocks(rgb: Rgb) -> AllBlocks:
    """The largest value of each block, those at the border and what is left of them included."""
    rows, columns = (-(-side // BLOCK_PX) for side in rgb.shape[:2])
    # Plane by plane and then along rows: reductions over short axes are ten times as slow.
    largest = np.maximum(np.maximum(rgb[..., 0], rgb[..., 1]), rgb[..., 2])
    room = (0, rows * BLOCK_PX - rgb.shape[0], 0, columns * BLOCK_PX - rgb.shape[1])
    padded = cv2.copyMakeBorder(largest, *room, cv2.BORDER_REPLICATE)
    of_rows = padded.reshape(rows, BLOCK_PX, columns * BLOCK_PX).max(axis=1)
    return of_rows.reshape(rows, columns, BLOCK_PX).max(axis=2)
