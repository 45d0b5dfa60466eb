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

UNLIKE = 0.05
"""A pixel that differs more from every slice, as shares of display white around it, is a mixture that none shows."""
_SAME_PX, _AROUND_PX = 1.0, 8.0
"""Standard deviations: noise and borders between slices within the first are no difference; differences are averaged over the second."""
LEAST_SHARE = 0.0003
"""Of 19 photographed stacks those without ghosts have at most a third of this share beyond UNLIKE, the others five times as much."""
MOVED_CONFIDENCE = 0.5
"""Confidence of the depth of what moved: the slice that shows it is known, and where it would have been sharpest is not."""

# Cells are cut apart or not; the finest are 8 px, and the long side has about so many of them.
_LEAST_CELL_PX, _CELLS = 8, 160
_PARTS = 4
"""Slices are compared in so many parts of a cell along each side, over this many of them."""
_PARTS_SIGMA = 1.0
_SEAM = 0.03
"""A cut between cells in which two slices differ by this share of white costs 1, and a little for its length, as each new cell does."""
_LENGTH, _TAKEN = 0.02, 0.05
_BLURRED = 3.5
"""What a cell costs that loses most of its detail, where it has as much as the median cell."""
_KEPT_DETAIL, _LOST_DETAIL, _MOST_TEXTURED = 0.8, 0.4, 3.0
_GHOST = 20.0
_NO_DATA = 1e3
_SWEEPS = 3
_PER_UNIT = 1000.0
"""Costs become whole numbers, for the maximal flow."""

Rgb = Float32[np.ndarray, "height width 3"]
Plane = Float32[np.ndarray, "height width"]
Mask = Bool[np.ndarray, "height width"]
Slices = Callable[[], Iterable[Rgb]]
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
    where the picture stayed. moved: (H, W) where ghosts were.
    """

    picture: Rgb
    before: float
    after: float
    chosen: Int16[np.ndarray, "height width"]
    moved: Mask

    def placed(self, focus: FocusMap) -> FocusMap:
        """Return depth from focus with what moved in the slice that shows it."""
        there = self.moved & (self.chosen >= 0)
        index = np.where(there, self.chosen.astype(np.float32), focus.focus_index)
        return replace(focus, focus_index=index, confidence=np.where(there, np.float32(MOVED_CONFIDENCE), focus.confidence))


def without_ghosts(picture: Rgb, slices: Slices, valid: Callable[[int], Mask], to_rec709: Callable[[Rgb], Rgb]) -> Mended | None:
    """Take the places around ghosts from one slice each; None where there are none, or where that does not halve them.

    picture: all in focus, in the RGB of the slices. slices: gives a fresh pass over them. valid: where one has data.
    """
    unlike = _unlike(picture, slices, valid, to_rec709)
    before = float((unlike > UNLIKE).mean())
    if before <= LEAST_SHARE:
        return None
    cells = _Cells.of(unlike)
    chosen = cells.chosen(picture, slices, valid, to_rec709)
    shares = ((rgb, (chosen == index).astype(np.float32)) for index, rgb in enumerate(slices()))
    mended = painted(picture, shares, (chosen >= 0).astype(np.float32), cells.bands)
    after = float((_unlike(mended, slices, valid, to_rec709) > UNLIKE).mean())
    if after > 0.5 * before:
        return None
    return Mended(picture=mended, before=before, after=after, chosen=chosen, moved=unlike > 0.5 * UNLIKE)


def _unlike(picture: Rgb, slices: Slices, valid: Callable[[int], Mask], to_rec709: Callable[[Rgb], Rgb]) -> Plane:
    likeness = Likeness(to_rec709(picture))
    for index, rgb in enumerate(slices()):
        likeness.add(to_rec709(rgb), valid(index))
    return likeness.unlike()


@dataclass(frozen=True)
class _Cells:
    """Grid of square cells over a picture. ghosts: (cells,) how unlike every slice the worst pixel of each is, in UNLIKE."""

    side_px: int
    shape: tuple[int, int]
    picture_shape: tuple[int, int]
    ghosts: OfCells

    @classmethod
    def of(cls, unlike: Plane) -> "_Cells":
        height, width = unlike.shape
        side_px = max(_LEAST_CELL_PX, -(-max(height, width) // (_CELLS * _PARTS)) * _PARTS)
        grid = cls(side_px, (-(-height // side_px), -(-width // side_px)), (height, width), np.zeros(0, np.float32))
        return replace(grid, ghosts=grid._parts(unlike / np.float32(UNLIKE), 1).max(axis=(1, 2)))

    @property
    def bands(self) -> int:
        """Return over how many bands slices go over into one another: brightness within about two cells."""
        return BANDS + round(np.log2(self.side_px / _LEAST_CELL_PX))

    def chosen(
        self, picture: Rgb, slices: Slices, valid: Callable[[int], Mask], to_rec709: Callable[[Rgb], Rgb]
    ) -> Int16[np.ndarray, "height width"]:
        """Return the slice that each pixel is taken from, -1 where the picture stays."""
        seen, details, missing = [self._seen(picture, to_rec709)[0]], [], []
        for index, rgb in enumerate(slices()):
            small, detail = self._seen(rgb, to_rec709)
            seen.append(small)
            details.append(detail)
            missing.append(self._parts((~valid(index)).astype(np.float32), 1).max(axis=(1, 2)) > 0)
        lost = _TAKEN + _lost_detail(np.stack(details)) + _NO_DATA * np.stack(missing)
        costs = np.concatenate([_GHOST * np.clip(self.ghosts - 0.4, 0.0, 2.0)[None], lost])
        labels = _Cut(self.shape, costs, np.stack(seen)).labels()
        grown = np.kron(labels.reshape(self.shape), np.ones((self.side_px,) * 2, int))
        return (grown[: self.picture_shape[0], : self.picture_shape[1]] - 1).astype(np.int16)

    def _seen(self, rgb: Rgb, to_rec709: Callable[[Rgb], Rgb]) -> tuple[UInt8[np.ndarray, "cells parts 3"], OfCells]:
        """Return the light of the parts of each cell, in codes, and the detail of the cell."""
        codes = _coded(to_rec709(rgb))
        fine = np.abs(cv2.Laplacian(cv2.cvtColor(codes, cv2.COLOR_RGB2GRAY), cv2.CV_32F, ksize=3))
        detail = self._parts(fine, 1).mean(axis=(1, 2)).reshape(self.shape)
        part_px = self.side_px // _PARTS
        smooth = cv2.GaussianBlur(codes, (0, 0), _PARTS_SIGMA * part_px)
        parts = self._parts(smooth.astype(np.float32), 3).reshape(len(self.ghosts), _PARTS, part_px, _PARTS, part_px, 3).mean(axis=(2, 4))
        return np.rint(parts).astype(np.uint8).reshape(len(parts), -1, 3), cv2.GaussianBlur(detail, (0, 0), 1.0).reshape(-1)

    def _parts(self, plane: Shaped[np.ndarray, "height width ..."], channels: int) -> Shaped[np.ndarray, "cells side_px side_px ..."]:
        """Return a picture cut into cells; the last ones are filled with its border."""
        (rows, columns), side = self.shape, self.side_px
        missing = [(0, rows * side - plane.shape[0]), (0, columns * side - plane.shape[1])] + [(0, 0)] * (plane.ndim - 2)
        cut = np.pad(plane, missing, "edge").reshape(rows, side, columns, side, channels).swapaxes(1, 2)
        cells = cut.reshape(rows * columns, side, side, channels)
        return cells if plane.ndim > 2 else cells[..., 0]


def _lost_detail(details: Float32[np.ndarray, "slices cells"]) -> Float[np.ndarray, "slices cells"]:
    """Return what it costs to see a cell in a slice in which it is blurred."""
    sharpest = details.max(axis=0)
    textured = np.minimum(sharpest / max(float(np.median(sharpest)), 1e-6), _MOST_TEXTURED)
    return _BLURRED * textured * np.clip((_KEPT_DETAIL - details / np.maximum(sharpest, 1e-6)) / (_KEPT_DETAIL - _LOST_DETAIL), 0.0, 1.0)


@dataclass(frozen=True)
class _Cut:
    """Labels of cells that cost the least together.

    shape: rows and columns. costs: of each label in each cell. seen: (labels, cells, parts, 3) what a label shows there, in codes.
    Neighbours of two labels cost by how much these differ in both cells, which is a metric of the labels, as expansion asks.
    """

    shape: tuple[int, int]
    costs: Float[np.ndarray, "labels cells"]
    seen: UInt8[np.ndarray, "labels cells parts 3"]

    def labels(self) -> Labels:
        """Expand one label after the other, beginning with 0 everywhere, until nothing gets cheaper."""
        labels = np.zeros(self.costs.shape[1], int)
        for _ in range(_SWEEPS):
            before = labels
            for label in range(len(self.costs)):
                labels = self._expanded(labels, label)
            if (labels == before).all():
                break
        return labels

    def cost(self, labels: Labels) -> float:
        """Return what labels cost together."""
        first, second = self._neighbours()
        return float(self.costs[labels, np.arange(len(labels))].sum() + self._seam(labels, labels, first, second).sum())

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
            apart = np.abs(self.seen[ours[cut], cells].astype(np.int16) - self.seen[theirs[cut], cells])
            cost[cut] += apart.max(axis=-1).mean(axis=-1) / (255.0 * _SEAM)
        cost[cut] += _LENGTH
        return cost
