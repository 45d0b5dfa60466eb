"""The all-in-focus picture: every pixel from the slice in which it is sharp, without seams where slices differ in brightness.

Slices are blended band by band (Burt and Adelson 1983): fine detail changes from slice to slice within a pixel or two, so that it
stays that of the sharp slice, brightness and tint within a few dozen. The result stays within what the slices show at each pixel, so that
bands add no halo and no light of their own.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import cv2
import numpy as np
from jaxtyping import Bool, Float32

from capture.merging.focus_volume import Blocks, FocusVolume, block_detail
from capture.stacks.slice_looks import BLOCK_PX
from mrbokeh.system.console import track

NARROW_CROSSOVER = 0.5
# Up to this blur between neighbouring slices both are sharp enough to be mixed anywhere between them.
SHARP_STEP_COC_PX = 2.0
# A block that keeps less of the detail of its sharpest slice is blended again; the gate of the report is at 0.6. Blur conserves light: a
# choice of slices that moves the brightness of a block by more than this, in square roots of light, puts a blurred slice in place.
KEPT_DETAIL = 0.66
LARGEST_MOVE = 0.02
# A mended block changes slices as far around it as fine bands reach; closer where that spoils the blocks beside it.
_AROUND_PX = 8
_CLOSE_PX = 3
# The coarsest band changes slices within about 2^(BANDS + 1) pixels.
BANDS = 4

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
BlockMask = Bool[np.ndarray, "rows columns"]


@dataclass
class BandBlend:
    """Weighted sum of pictures under construction, band by band in the square root of light. The weights of all must sum to 1.

    shape: (H, W). darkest, brightest: the extremes of all slices per pixel and channel.
    """

    shape: tuple[int, ...]
    bands: int = BANDS
    darkest: Rgb | None = None
    brightest: Rgb | None = None
    _sums: list[Rgb] = field(default_factory=list)

    def add(self, rgb: Rgb, weight: Plane) -> None:
        """Add a picture (H, W, 3) with its weight (H, W)."""
        self._widen(rgb)
        self.change(rgb, weight)

    def change(self, rgb: Rgb, weight: Plane) -> None:
        """Add to the weight of a picture that was added before."""
        box = self._box(weight)
        if box is None:
            return
        picture, share = cv2.sqrt(np.maximum(rgb[box], 0.0)), np.ascontiguousarray(weight[box])
        sums = self._levels()
        for level in range(self.bands + 1):
            window = sums[level][tuple(slice(each.start >> level, -(-each.stop >> level)) for each in box)]
            if level == self.bands:
                cv2.accumulateProduct(picture, cv2.merge([share] * 3), window)
                return
            smaller = cv2.pyrDown(picture)
            band = cv2.subtract(picture, cv2.pyrUp(smaller, dstsize=picture.shape[1::-1]))
            cv2.accumulateProduct(band, cv2.merge([share] * 3), window)
            picture, share = smaller, cv2.pyrDown(share)

    def result(self) -> Rgb:
        """Return the picture (H, W, 3) in linear light."""
        picture = self._sums[-1]
        for band in reversed(self._sums[:-1]):
            picture = cv2.add(band, cv2.pyrUp(picture, dstsize=band.shape[1::-1]))
        picture = np.maximum(picture, 0.0)
        return np.clip(picture * picture, self.darkest, self.brightest)

    def reached(self, share: Plane) -> Bool[np.ndarray, "height width"]:
        """Return where a picture of this weight (H, W) can have changed anything."""
        size = 2 * (4 << self.bands) + 1
        return cv2.dilate((share > 0).astype(np.uint8), np.ones((size, size), np.uint8)) > 0

    def _widen(self, rgb: Rgb) -> None:
        if self.darkest is None or self.brightest is None:
            self.darkest, self.brightest = rgb.copy(), rgb.copy()
            return
        cv2.min(self.darkest, rgb, dst=self.darkest)
        cv2.max(self.brightest, rgb, dst=self.brightest)

    def _levels(self) -> list[Rgb]:
        if not self._sums:
            height, width = self.shape[:2]
            self._sums = [np.zeros((-(-height >> level), -(-width >> level), 3), np.float32) for level in range(self.bands + 1)]
        return self._sums

    def _box(self, weight: Plane) -> tuple[slice, slice] | None:
        """Return the window that a picture changes: its weights, as far as the coarsest band carries them, on the grid of that band."""
        step, (height, width) = 1 << self.bands, self.shape[:2]
        x, y, across, down = cv2.boundingRect((weight != 0.0).view(np.uint8))
        if not across:
            return None
        reach = 4 * step
        top, left = (max(first - reach, 0) // step * step for first in (y, x))
        bottom, right = (-(-(end + reach) // step) * step for end in (y + down, x + across))
        return slice(top, min(bottom, height)), slice(left, min(right, width))


def sharp_all_in_focus(
    slices: Callable[[], Iterable[Rgb]], focus_index: Plane, volume: FocusVolume, crossover: float = NARROW_CROSSOVER
) -> Rgb:
    """Blend registered slices, and again where a block has lost detail that one of them has.

    The focus index is smooth over places that decide little; where a slice shows clearly more detail than came out, pixels are taken
    from their sharpest slice, and if that does not help, the block from its own. slices: gives a fresh pass over them.
    """
    blend, taken = BandBlend(focus_index.shape), focus_index
    for index, rgb in enumerate(track(slices(), "all in focus", len(volume.energies))):
        blend.add(rgb, slice_weight(focus_index, index, crossover))

    def blended_as(wanted: Plane) -> Rgb:
        nonlocal taken
        for index, rgb in enumerate(slices()):
            blend.change(rgb, slice_weight(wanted, index, crossover) - slice_weight(taken, index, crossover))
        taken = wanted
        return blend.result()

    picture = blend.result()
    pixels = volume.enlarged(volume.energies.argmax(axis=0).astype(np.float32), 0.0)
    blocks = _per_pixel(np.argmax(volume.details, axis=0).astype(np.float32), volume.shape)
    for choice, around_px in ((pixels, _AROUND_PX), (blocks, _AROUND_PX), (blocks, _CLOSE_PX)):
        lost, before = _lost_blocks(picture, volume), taken
        if not lost.any():
            break
        proposed = blended_as(_taken_from(choice, lost, before, around_px))
        # Beside strong edges a block may gain the blurred rim of a slice, and its neighbours lose what they had.
        helped = _helped(lost, _lost_blocks(proposed, volume), _moved_blocks(picture, proposed))
        if helped.any() and (helped != lost).any():
            proposed = blended_as(_taken_from(choice, helped, before, around_px))
            helped &= _lost_blocks(proposed, volume).sum() < lost.sum()
        picture = proposed if helped.any() else blended_as(before)
    return picture


def painted(picture: Rgb, slices: Iterable[tuple[Rgb, Plane]], share: Plane, bands: int = BANDS) -> Rgb:
    """Blend slices into a picture, each by its share (H, W); what lies beyond the reach of the bands stays bit for bit.

    share: the sum of all shares, within 0 to 1.
    """
    blend = BandBlend(share.shape, bands)
    blend.add(picture, np.float32(1.0) - share)
    for rgb, own in slices:
        if own.any():
            blend.add(rgb, own)
    return np.where(blend.reached(share)[..., None], blend.result(), picture)


def slice_weight(focus_index: Plane, index: int, crossover: float = NARROW_CROSSOVER) -> Plane:
    """Return how much slice `index` gives to each pixel: all near its own focus, crossing over half way to the next slice.

    The weights of all slices sum to 1. The cross-over takes the given share of a step, where both slices are about equally
    sharp, so that it lessens the noise there and leaves no seam; 1 is linear interpolation.
    """
    distance = np.abs(focus_index - np.float32(index))
    distance *= np.float32(-1.0 / crossover)
    distance += np.float32(0.5 / crossover + 0.5)
    return np.clip(distance, 0.0, 1.0, out=distance)


def crossover_of(step_coc_px: float) -> float:
    """Return the share of a step to cross over in; step_coc_px: the circle of confusion of one slice's focus in the next slice."""
    return float(np.clip(SHARP_STEP_COC_PX / max(step_coc_px, 1e-6), NARROW_CROSSOVER, 1.0))


def _helped(lost: BlockMask, still_lost: BlockMask, moved: BlockMask) -> BlockMask:
    """Return the lost blocks that another choice of slices mends without harm to a block beside them, in detail or in brightness."""
    harmed = cv2.dilate(((still_lost & ~lost) | moved).astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    return lost & ~still_lost & ~harmed


def _moved_blocks(before: Rgb, after: Rgb) -> BlockMask:
    rows, columns = (max(side // BLOCK_PX, 1) for side in before.shape[:2])
    change = cv2.subtract(*(cv2.sqrt(np.maximum(each[: rows * BLOCK_PX, : columns * BLOCK_PX], 0.0)) for each in (before, after)))
    return np.abs(cv2.resize(change, (columns, rows), interpolation=cv2.INTER_AREA)).max(axis=2) > LARGEST_MOVE


def _lost_blocks(merged: Rgb, volume: FocusVolume) -> BlockMask:
    sharpest = np.max(volume.details, axis=0)
    return (sharpest > 0.5 * np.median(sharpest)) & (block_detail(np.sqrt(np.maximum(merged, 0.0))) < KEPT_DETAIL * sharpest)


def _taken_from(choice: Plane, lost: BlockMask, focus_index: Plane, around_px: int) -> Plane:
    """Return the focus index with another choice in the lost blocks and around them."""
    chosen = np.where(_per_pixel(lost.astype(np.float32), focus_index.shape) > 0, choice, np.float32(-1.0))
    around = cv2.dilate(chosen, np.ones((2 * around_px + 1,) * 2, np.uint8))
    chosen = np.where(chosen >= 0, chosen, around)
    return np.where(chosen >= 0, chosen, focus_index)


def _per_pixel(blocks: Blocks, shape: tuple[int, ...]) -> Plane:
    """Return the value of its block for each pixel; what is cut off from the blocks belongs to the last ones."""
    grown = np.kron(blocks, np.ones((BLOCK_PX, BLOCK_PX), np.float32))
    missing = [(0, max(full - size, 0)) for full, size in zip(shape, grown.shape, strict=True)]
    return np.pad(grown, missing, "edge")[: shape[0], : shape[1]]
