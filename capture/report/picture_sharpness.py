"""Sharpness of an all-in-focus picture beside its slices, measured without truth, lens or focus distances, in one pass over them.

The detail of a block is that of the display-encoded luminance (`capture.stacks.slice_looks`). The measures hold for any tool's result,
once it lies on the registered slices.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import repeat

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Int, Shaped

from capture.merging.ghosts import UNLIKE, Likeness
from capture.stacks.slice_looks import BLOCK_PX, detail_of_blocks
from mrbokeh.images.color import linear_to_srgb

BORDER_BLOCKS = 2
"""Blocks at the border of the picture that are left out: slices have no data there, or mirrored data."""
KEPT_DETAIL = 0.6
FLAT_PERCENTILE = 30.0
FEWEST_FLAT = 20
"""Fewer blocks have no 95th percentile; a picture of 288 x 312 pixels has as many."""

Rgb = Float32[np.ndarray, "height width 3"]
Blocks = Float32[np.ndarray, "rows columns"]
BlockMask = Bool[np.ndarray, "rows columns"]
Mask = Bool[np.ndarray, "height width"]
AllBlocks = Float32[np.ndarray, "all_rows all_columns"]


@dataclass(frozen=True)
class SharpestSlices:
    """Detail that the registered slices of a stack reach, block by block.

    detail: of the sharpest slice of each block. index: which slice that is. largest: the largest linear value of all slices.
    """

    detail: Blocks
    index: Int[np.ndarray, "rows columns"]
    largest: float

    @classmethod
    def of(cls, slices: Iterable[Rgb], valid: Iterable[Mask | None] = repeat(None)) -> "SharpestSlices":
        """Read the slices (linear Rec.709, one size) once. valid: where each has data, None for everywhere."""
        details, largest = [], 0.0
        for rgb, known in zip(slices, valid, strict=False):
            details.append(block_detail(rgb, known))
            largest = max(largest, float(rgb.max()))
        return cls.of_details(details, largest)

    @classmethod
    def of_details(cls, details: Sequence[Blocks], largest: float) -> "SharpestSlices":
        """Compare slices by their details (see `block_detail`), 0 where a slice has no data. largest: linear value of all slices."""
        stacked = np.stack(details)
        return cls(stacked.max(axis=0), stacked.argmax(axis=0), largest)

    @cached_property
    def textured(self) -> BlockMask:
        """Return blocks with more detail than the median block."""
        return self.detail > np.median(self.detail)

    @cached_property
    def flat(self) -> BlockMask:
        return self.detail < np.percentile(self.detail, FLAT_PERCENTILE)

    def measure(self, picture: Rgb) -> "Sharpness":
        """Measure an all-in-focus picture that lies on the slices: linear Rec.709 of their size."""
        kept = block_detail(picture) / np.maximum(self.detail, 1e-9)
        lost = self.textured & (kept < KEPT_DETAIL)
        share = float(lost.sum() / max(int(self.textured.sum()), 1))
        raised = float(np.percentile(kept[self.flat], 95.0)) if self.flat.any() else 0.0
        return Sharpness(lost=share, flat=raised, top=float(picture.max()) / max(self.largest, 1e-9), kept=kept, lost_blocks=lost)


@dataclass(frozen=True)
class Sharpness:
    """Sharpness of an all-in-focus picture beside its slices.

    lost: share of the textured blocks that keep less than KEPT_DETAIL of the detail of their sharpest slice.
    flat: 95th percentile, over flat blocks, of their detail over that of the sharpest slice; seams and noise raise it above 1.
    top: largest linear value over the largest of all slices.
    kept: detail of each block over that of its sharpest slice. lost_blocks: which blocks are lost.
    """

    lost: float
    flat: float
    top: float
    kept: Blocks
    lost_blocks: BlockMask


@dataclass(frozen=True)
class PictureFindings:
    """Numbers of a picture beside its slices (see `Sharpness`).

    unlike: share of the picture that is unlike every slice. lost: None where the picture has no textured blocks. flat: None where it has
    fewer than FEWEST_FLAT flat ones. top, slices_top: largest value of the picture and of all slices, in the RGB in which they are
    stored. seen_px: width and height of what was looked at.
    """

    unlike: float
    lost: float | None
    flat: float | None
    top: float
    slices_top: float
    seen_px: tuple[int, int]

    @property
    def top_ratio(self) -> float:
        return self.top / max(self.slices_top, 1e-9)


class PictureEvidence:
    """Evidence of the slices, taken one after the other: a number or two of each block, and how unlike them each pixel is."""

    def __init__(self, picture: Rgb) -> None:
        """Take the all-in-focus picture, of the size of the slices' files."""
        self._likeness = Likeness(picture)
        self._details: list[Blocks] = []
        self._brightest: list[AllBlocks] = []

    def add(self, rgb: Rgb, camera_rgb: Rgb, valid: Mask) -> None:
        """Add a slice at the size of its file, in Rec.709 and as it is stored; blocks in which it lacks data do not count as sharp."""
        self._likeness.add(rgb, valid)
        self._details.append(block_detail(rgb, valid))
        self._brightest.append(_largest_of_blocks(camera_rgb))

    def look(self, picture: Rgb, camera_rgb: Rgb) -> "PictureLook":
        """Compare the picture with the slices. picture, camera_rgb: all in focus, of the slices' size."""
        of_slices = np.stack(self._brightest)
        sharpest = SharpestSlices.of_details(self._details, float(of_slices.max()))
        sharpness = sharpest.measure(picture) if sharpest.detail.size else None
        return PictureLook(
            unlike=self._likeness.unlike(),
            sharpest=sharpest,
            sharpness=sharpness,
            picture=picture,
            brightest=_largest_of_blocks(camera_rgb),
            slices_brightest=of_slices.max(axis=0),
            brightest_slice=of_slices.argmax(axis=0),
        )


@dataclass(frozen=True)
class PictureLook:
    """Picture and what its slices reach. sharpness: None where the picture is smaller than a block.

    unlike: by how much the surroundings of a pixel differ from the slice that is most like each of theirs; 1 is display white.
    brightest, slices_brightest, brightest_slice: the largest value of the picture in each block, border blocks included, that of all
    slices there, and whose it is.
    """

    unlike: Float32[np.ndarray, "height width"]
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
        return PictureFindings(
            unlike=float((self.unlike > UNLIKE).mean()),
            lost=lost,
            flat=flat,
            top=float(self.brightest.max()),
            slices_top=self.sharpest.largest,
            seen_px=size_px,
        )

    def corner_px(self, row: int, column: int) -> tuple[int, int]:
        """Return x, y of the first pixel of a block of `sharpest`."""
        border = border_blocks(self.picture.shape)
        return (column + border) * BLOCK_PX, (row + border) * BLOCK_PX


def display_luminance(rgb: Rgb) -> Float32[np.ndarray, "height width"]:
    """Return the luminance of linear Rec.709 as displayed: encoded by the sRGB curve, clipped to 1."""
    return linear_to_srgb(np.clip(rgb, 0.0, 1.0)) @ np.array([0.2126, 0.7152, 0.0722], np.float32)


def block_detail(rgb: Rgb, valid: Mask | None = None) -> Blocks:
    """Return the detail of every block of linear Rec.709 (1.0 is display white); border blocks and a rest below BLOCK_PX are cut off.

    valid: where the picture has data; blocks in which it lacks some have no detail, however sharp what stands for it may be.
    """
    detail = detail_of_blocks(display_luminance(rgb))[_inside(rgb.shape)]
    return detail if valid is None or valid.all() else np.where(inner_blocks(valid).all(axis=(1, 3)), detail, np.float32(0.0))


def inner_blocks(plane: Shaped[np.ndarray, "height width"]) -> Shaped[np.ndarray, "rows block columns block"]:
    """Return a plane cut into its blocks, those at the border and a rest below BLOCK_PX left out."""
    rows, columns = (side // BLOCK_PX for side in plane.shape)
    down, across = _inside(plane.shape)
    return plane[: rows * BLOCK_PX, : columns * BLOCK_PX].reshape(rows, BLOCK_PX, columns, BLOCK_PX)[down, :, across]


def border_blocks(shape: tuple[int, ...]) -> int:
    """Return how many blocks are left out at each side of a picture of (height, width): fewer than BORDER_BLOCKS where it is small."""
    rows, columns = (side // BLOCK_PX for side in shape[:2])
    return min(BORDER_BLOCKS, (rows - 1) // 2, (columns - 1) // 2) if min(rows, columns) else 0


def _inside(shape: tuple[int, ...]) -> tuple[slice, slice]:
    """Return rows and columns of the blocks that are not at the border."""
    border = border_blocks(shape)
    down, across = (slice(border, side // BLOCK_PX - border) for side in shape[:2])
    return down, across


def _largest_of_blocks(rgb: Rgb) -> AllBlocks:
    """Return the largest value of each block, those at the border and what is left of them included."""
    rows, columns = (-(-side // BLOCK_PX) for side in rgb.shape[:2])
    # Plane by plane and then along rows: reductions over short axes are ten times as slow.
    largest = np.maximum(np.maximum(rgb[..., 0], rgb[..., 1]), rgb[..., 2])
    room = (0, rows * BLOCK_PX - rgb.shape[0], 0, columns * BLOCK_PX - rgb.shape[1])
    padded = cv2.copyMakeBorder(largest, *room, cv2.BORDER_REPLICATE)
    of_rows = padded.reshape(rows, BLOCK_PX, columns * BLOCK_PX).max(axis=1)
    return of_rows.reshape(rows, columns, BLOCK_PX).max(axis=2)
