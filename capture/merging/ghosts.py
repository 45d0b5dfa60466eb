"""Ghosts of an all-in-focus picture: what moved between the slices and shines through what stands behind it.

A merged pixel comes from a slice. Where the picture is unlike every slice it mixes two that show different things: somebody who walked by,
a leaf in the wind, a hand. There it is cut anew, so that each place comes whole from one slice and the cuts lie where the slices agree
(Agarwala et al. 2004, Interactive digital photomontage; labels by the alpha expansion of Boykov, Veksler and Zabih 2001).
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32, Int, Int16, Shaped, UInt8
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from capture.merging.all_in_focus import BANDS, painted
from capture.merging.depth_from_focus import FocusMap
from mrbokeh.images.color import srgb_codes
from mrbokeh.system.console import track

UNLIKE = 0.05
"""A pixel that differs more from every slice, as shares of display white around it, is a mixture that none shows."""
_SAME_PX, _AROUND_PX = 1.0, 8.0
"""Standard deviations: noise and borders between slices within the first are no difference; differences are averaged over the second."""
LEAST_SHARE = 0.0003
"""Share of the picture beyond UNLIKE: 35 photographed stacks without ghosts have at most 0.4 of it, five with some at least three times."""
MOVED_CONFIDENCE = 0.25
"""Largest confidence of the depth of what moved: the slice that shows it is known, and where it would have been sharpest is not."""

_LEAST_CELL_PX, _CELLS = 8, 160
"""Sides of the cells that are taken from one slice each, and how many lie along the long side of a large picture, at least."""
_PARTS = 4
"""Two slices are compared in this many parts of a cell along each side, blurred by a part."""
_SEAM = 0.03
"""A seam between cells in which two slices differ by this share of white costs 1."""
_LENGTH, _TAKEN = 0.02, 0.05
"""What any seam costs for its length, and a cell that does not stay as it was."""
_BLURRED, _MOST_TEXTURED = 3.0, 3.0
"""What a cell costs in a slice without its detail, times its detail in that of the median cell, up to the second."""
_KEPT_DETAIL, _LOST_DETAIL = 0.8, 0.4
"""Shares of a cell's detail: with the first nothing is lost, with the second everything."""
_GHOST, _LEAST_UNLIKE, _MOST_UNLIKE = 20.0, 0.4, 2.4
"""What a cell costs that stays unlike every slice, for each UNLIKE from the second to the third."""
_NO_DATA, _MISSING = 1e3, 0.1
"""What a cell costs in a slice that lacks more than the second of it."""
_CHANGED = 0.5
"""Where the mended picture differs from the picture by more than this share of UNLIKE, something else is seen."""
_SWEEPS = 3
_PER_UNIT = 1000.0
"""Costs become whole numbers, for the maximal flow."""

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Slices = Callable[[], Iterable[Rgb]]
Seen = Callable[[], Iterable[tuple[Rgb, Mask]]]
Codes = UInt8[np.ndarray, "height width 3"]
Labels = Int[np.ndarray, " cells"]
Borders = Int[np.ndarray, " borders"]
OfCells = Float32[np.ndarray, " cells"]


class Likeness:
    """How unlike all slices a picture is, pixel by pixel; slices are shown one after the other."""

    def __init__(self, picture: Rgb) -> None:
        """Take a picture in linear Rec.709."""
        self._coded = _coded(picture)
        self._unlike = np.full(picture.shape[:2], 255, np.uint8)
        self._seen = np.zeros(picture.shape[:2], bool)

    def add(self, rgb: Rgb, valid: Mask) -> None:
        """Show a slice of the picture's size, and where it has data."""
        np.minimum(self._unlike, cv2.absdiff(self._coded, _coded(rgb)).max(axis=2), out=self._unlike, where=valid)
        self._seen |= valid

    def unlike(self) -> Plane:
        """Return by how much the surroundings of a pixel differ from the slice most like each of theirs; 1 is display white."""
        unlike = np.where(self._seen, self._unlike, 0).astype(np.float32) / np.float32(255.0)
        return cv2.GaussianBlur(unlike, (0, 0), _AROUND_PX)


def _coded(rgb: Rgb) -> Codes:
    """Return linear Rec.709 as displayed, in 8 bits, without what noise and the border of a pixel change."""
    return cv2.GaussianBlur(srgb_codes(rgb, np.uint8), (0, 0), _SAME_PX)


@dataclass(frozen=True)
class Mended:
    """A picture without its ghosts.

    before, after: share of the picture that is unlike every slice. chosen: (H, W) index of the slice that a place was taken from, -1
    where the picture stayed. sharp: (H, W) where that slice has detail that the sharpest one has. changed: (H, W) where something else is
    seen than before.
    """

    picture: Rgb
    before: float
    after: float
    chosen: Int16[np.ndarray, "height width"]
    sharp: Mask
    changed: Mask

    def placed(self, focus: FocusMap) -> FocusMap:
        """Return depth from focus with what is seen anew in the slice that shows it sharp; nowhere there it is sure."""
        there = self.changed & (self.chosen >= 0)
        index = np.where(there & self.sharp, self.chosen.astype(np.float32), focus.focus_index)
        sure = np.where(there, np.minimum(focus.confidence, np.float32(MOVED_CONFIDENCE)), focus.confidence)
        return replace(focus, focus_index=index, confidence=sure)


def without_ghosts(picture: Rgb, slices: Slices, seen: Seen, to_rec709: Callable[[Rgb], Rgb]) -> Mended | None:
    """Take the places around ghosts from one slice each; None where there are none, or where that does not halve them.

    picture: all in focus, in the RGB of the slices. slices, seen: give fresh passes over them, the second in linear Rec.709 and with where
    each has data.
    """
    unlike = unlike_slices(to_rec709(picture), seen())
    before = float((unlike > UNLIKE).mean())
    if before <= LEAST_SHARE:
        return None
    cells = _Cells.over(unlike)
    chosen, sharp = cells.chosen(unlike, to_rec709(picture), seen())
    taken = ((rgb, (chosen == index).astype(np.float32)) for index, rgb in enumerate(slices()))
    mended = painted(picture, taken, (chosen >= 0).astype(np.float32), cells.bands)
    after = float((unlike_slices(to_rec709(mended), seen()) > UNLIKE).mean())
    if after > 0.5 * before:
        return None
    everywhere = np.ones(chosen.shape, bool)
    changed = unlike_slices(to_rec709(picture), [(to_rec709(mended), everywhere)]) > _CHANGED * UNLIKE
    return Mended(picture=mended, before=before, after=after, chosen=chosen, sharp=sharp, changed=changed)


def unlike_slices(picture: Rgb, seen: Iterable[tuple[Rgb, Mask]]) -> Plane:
    """Return how unlike all slices a picture is, as `Likeness` does. seen: slices in linear Rec.709, and where each has data."""
    likeness = Likeness(picture)
    for rgb, valid in seen:
        likeness.add(rgb, valid)
    return likeness.unlike()


@dataclass(frozen=True)
class _Cells:
    """Grid of square cells over a picture of (H, W); the last ones reach beyond it."""

    side_px: int
    shape: tuple[int, int]

    @classmethod
    def over(cls, plane: Plane) -> "_Cells":
        height, width = plane.shape
        side_px = max(_LEAST_CELL_PX, max(height, width) // (_CELLS * _PARTS) * _PARTS)
        return cls(side_px, (-(-height // side_px), -(-width // side_px)))

    @property
    def bands(self) -> int:
        """Return over how many bands slices go over into one another: brightness within four to six cells."""
        return BANDS + round(np.log2(self.side_px / _LEAST_CELL_PX))

    def chosen(
        self, unlike: Plane, picture: Rgb, seen: Iterable[tuple[Rgb, Mask]]
    ) -> tuple[Int16[np.ndarray, "height width"], Bool[np.ndarray, "height width"]]:
        """Return the slice that each pixel is taken from, -1 where the picture stays, and where that slice is sharp. All are Rec.709."""
        (rows, columns), side = self.shape, self.side_px
        worst = self._padded(unlike).reshape(rows, side, columns, side).max(axis=(1, 3)).reshape(-1) / np.float32(UNLIKE)
        shown, details, missing = [self._parts(_coded(picture))], [], []
        for rgb, valid in seen:
            codes = _coded(rgb)
            shown.append(self._parts(codes))
            details.append(self._detail(codes))
            missing.append(self._means((~valid).astype(np.float32)) > _MISSING)
        kept = np.stack(details) / np.maximum(np.max(details, axis=0), 1e-6)
        lost = _TAKEN + _lost_detail(np.stack(details), kept) + _NO_DATA * np.stack(missing)
        stays = _GHOST * (np.clip(worst, _LEAST_UNLIKE, _MOST_UNLIKE) - _LEAST_UNLIKE)
        labels = _Cut(self.shape, np.concatenate([stays[None], lost]), np.stack(shown)).labels().astype(np.int16) - 1
        sharp = np.take_along_axis(kept, np.maximum(labels, 0)[None], axis=0)[0] >= 0.5 * (_KEPT_DETAIL + _LOST_DETAIL)
        return self._grown(labels, unlike.shape), self._grown(sharp, unlike.shape)

    def _grown(self, cells: Shaped[np.ndarray, " cells"], shape: tuple[int, ...]) -> Shaped[np.ndarray, "height width"]:
        """Return the pixels of cells, in a picture of (H, W)."""
        pixels = cells.reshape(self.shape).repeat(self.side_px, axis=0).repeat(self.side_px, axis=1)
        return pixels[: shape[0], : shape[1]]

    def _detail(self, codes: Codes) -> OfCells:
        fine = np.abs(cv2.Laplacian(cv2.cvtColor(codes, cv2.COLOR_RGB2GRAY), cv2.CV_32F, ksize=3))
        return cv2.GaussianBlur(self._means(fine).reshape(self.shape), (0, 0), 1.0).reshape(-1)

    def _means(self, plane: Plane) -> OfCells:
        return cv2.resize(self._padded(plane), self.shape[::-1], interpolation=cv2.INTER_AREA).reshape(-1)

    def _parts(self, codes: Codes) -> UInt8[np.ndarray, "cells parts 3"]:
        """Return the light of the parts of each cell, in codes."""
        rows, columns = self.shape
        small = cv2.resize(self._padded(codes), (columns * _PARTS, rows * _PARTS), interpolation=cv2.INTER_AREA)
        parts = cv2.GaussianBlur(small, (0, 0), 1.0).reshape(rows, _PARTS, columns, _PARTS, 3).swapaxes(1, 2)
        return parts.reshape(rows * columns, _PARTS * _PARTS, 3)

    def _padded(self, plane: Shaped[np.ndarray, "height width ..."]) -> Shaped[np.ndarray, "padded_height padded_width ..."]:
        down, right = (count * self.side_px - size for count, size in zip(self.shape, plane.shape, strict=False))
        return cv2.copyMakeBorder(plane, 0, down, 0, right, cv2.BORDER_REPLICATE)


def _lost_detail(
    details: Float32[np.ndarray, "slices cells"], kept: Float32[np.ndarray, "slices cells"]
) -> Float[np.ndarray, "slices cells"]:
    """Return what it costs to see a cell in a slice in which it is blurred. kept: details as shares of those of the sharpest slice."""
    sharpest = details.max(axis=0)
    textured = np.minimum(sharpest / max(float(np.median(sharpest)), 1e-6), _MOST_TEXTURED)
    return _BLURRED * textured * np.clip((_KEPT_DETAIL - kept) / (_KEPT_DETAIL - _LOST_DETAIL), 0.0, 1.0)


@dataclass(frozen=True)
class _Cut:
    """Labels of cells that cost the least together.

    shape: rows and columns. costs: of each label in each cell. shown: (labels, cells, parts, 3) what a label shows there, in codes.
    Neighbours of two labels cost by how much these differ in both cells, which is a metric of the labels, as expansion asks.
    """

    shape: tuple[int, int]
    costs: Float[np.ndarray, "labels cells"]
    shown: UInt8[np.ndarray, "labels cells parts 3"]

    def labels(self) -> Labels:
        """Expand one label after the other, beginning with 0 everywhere, until nothing gets cheaper."""
        labels = np.zeros(self.costs.shape[1], int)
        for _ in range(_SWEEPS):
            before = labels
            for label in track(range(len(self.costs)), "what moved"):
                labels = self._expanded(labels, label)
            if (labels == before).all():
                break
        return labels

    def _expanded(self, labels: Labels, label: int) -> Labels:
        """Let the cells take a label that are cheaper with it, all at once: the least cut between those that stay and those that change."""
        count = len(labels)
        (first, second), new = self._neighbours(), np.full(count, label)
        stay, leave, enter = (self._seam(*pair, first, second) for pair in ((labels, labels), (labels, new), (new, labels)))
        change = self.costs[label] - self.costs[labels, np.arange(count)]
        change += np.bincount(first, enter - stay, count) - np.bincount(second, enter, count)
        source, sink, cells = np.full(count, count), np.full(count, count + 1), np.arange(count)
        capacity = np.concatenate([np.maximum(leave + enter - stay, 0.0), np.maximum(change, 0.0), np.maximum(-change, 0.0)])
        ends = np.concatenate([first, source, cells]), np.concatenate([second, cells, sink])
        graph = coo_matrix((np.rint(_PER_UNIT * capacity).astype(np.int32), ends), shape=(count + 2, count + 2)).tocsr()
        left = graph - maximum_flow(graph, count, count + 1).flow
        left.data = np.maximum(left.data, 0)
        left.eliminate_zeros()
        stays = np.zeros(count + 2, bool)
        stays[breadth_first_order(left, count, return_predecessors=False)] = True
        return np.where(stays[:count], labels, label)

    def _neighbours(self) -> tuple[Borders, Borders]:
        """Return the cells on both sides of each border, beside one another and below one another."""
        cells = np.arange(self.shape[0] * self.shape[1]).reshape(self.shape)
        first, second = (cells[:, :-1], cells[:-1]), (cells[:, 1:], cells[1:])
        return np.concatenate([each.ravel() for each in first]), np.concatenate([each.ravel() for each in second])

    def _seam(self, labels: Labels, others: Labels, first: Borders, second: Borders) -> Float[np.ndarray, " borders"]:
        """Return what borders cost whose first cell has its label of `labels`, and whose second has its of `others`."""
        ours, theirs = labels[first], others[second]
        cut = np.flatnonzero(ours != theirs)
        cost = np.zeros(len(first))
        for cells in (first[cut], second[cut]):
            apart = np.abs(self.shown[ours[cut], cells].astype(np.int16) - self.shown[theirs[cut], cells])
            cost[cut] += apart.max(axis=-1).mean(axis=-1) / (255.0 * _SEAM)
        cost[cut] += _LENGTH
        return cost
