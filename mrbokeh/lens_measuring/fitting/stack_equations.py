"""Equations of focal stacks: pixels of their slices whose blur is known well enough to tell the shape of the kernel.

Counted are pixels with a trusted depth, not clipped, and far from every edge of depth by more than light travels there: around edges, what
is hidden and what hides mix, which a kernel cannot explain. Among them those are drawn (weighted sampling without replacement, Efraimidis
and Spirakis 2006) that see contrast, evenly over the field.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.ndimage import distance_transform_edt

from mrbokeh.images.camera_rgb import SliceMasks
from mrbokeh.lens_measuring.fitting.evidence import DARK, Equations, Knots
from mrbokeh.lens_measuring.fitting.pupil_picture import EXTENT, PupilGrid
from mrbokeh.stacks.focal_stack import FocalStack
from mrbokeh.system.errors import InputError

if TYPE_CHECKING:
    from mrbokeh.lens_measuring.fitting.blur_pairs import BlurPair

LEAST_DIAMETER_PX = 3.0
"""Smaller kernels are a few pixels and say little about their shape."""

_NO_TRUTH = ("moving", "border", "board")
_LEAST_CONFIDENCE = 0.1
_JUMP_PX, _JUMP_SHARE = 0.75, 0.1
_CONTRAST_PX = 9
_LEAST_CONTRAST = 0.01

Plane = Float32[np.ndarray, "height width"]
Rgb = Float32[np.ndarray, "height width 3"]
Mask = Bool[np.ndarray, "height width"]


@dataclass(frozen=True)
class SliceView:
    """Registered slice, the all-in-focus picture and the signed diameters of both; known: where depth and slice can be trusted."""

    sharp: Rgb
    blurred: Rgb
    coc_px: Plane
    known: Mask

    def field_xy(self, where: Int64[np.ndarray, "points 2"]) -> Float64[np.ndarray, "points 2"]:
        """Return positions of pixels (row, column) in half diagonals."""
        height, width = self.coc_px.shape
        middle = np.array([0.5 * width - 0.5, 0.5 * height - 0.5])
        return np.asarray((where[:, ::-1] - middle) / (0.5 * np.hypot(width, height)))


def known_pixels(confidence: Plane, masks: SliceMasks, exclusions: Mapping[str, Mask]) -> Mask:
    """Return the pixels with a trusted depth whose light was measured."""
    known = (confidence >= _LEAST_CONFIDENCE) & masks.valid & ~masks.saturated
    for reason in (*_NO_TRUTH, "low_confidence"):
        known &= ~exclusions.get(reason, np.zeros_like(known))
    return np.asarray(known)


def smoothed_coc(coc_px: Plane, confidence: Plane) -> Plane:
    """Remove the noise of single pixels from a map of diameters, keeping its edges.

    What is thin (a light in front of a wall, a wire) keeps its own diameter if its depth is trusted: lost to its surroundings its light
    would be taken for theirs, and one light outshines all that tells of the kernel there.
    """
    smooth = cv2.medianBlur(np.ascontiguousarray(coc_px), 5)
    thin = (np.abs(coc_px - smooth) > _jump_px(coc_px)) & (confidence >= _LEAST_CONFIDENCE)
    return np.asarray(np.where(thin, coc_px, smooth), np.float32)


def _jump_px(coc_px: Plane) -> Plane:
    """Return what two neighbours of one surface differ by at most."""
    return np.maximum(np.float32(_JUMP_PX), np.float32(_JUMP_SHARE) * np.abs(coc_px))


def usable_pixels(view: SliceView) -> Mask:
    """Return pixels that are known, blurred enough, and farther from edges of depth and frame than light travels."""
    size = np.abs(view.coc_px)
    square = np.ones((3, 3), np.uint8)
    jump = cv2.dilate(view.coc_px, square) - cv2.erode(view.coc_px, square)
    edges = jump > _jump_px(size)
    reach = 0.5 * size
    inside = np.ones_like(edges)
    if edges.any():
        away, (rows, columns) = distance_transform_edt(~edges, return_indices=True)
        widest = cv2.dilate(size, np.ones((5, 5), np.uint8))
        inside = away > np.maximum(reach, 0.5 * widest[rows, columns]) + 1.0
    height, width = size.shape
    row, column = np.arange(height)[:, None] + 0.5, np.arange(width)[None, :] + 0.5
    from_frame = np.minimum(np.minimum(row, height - row), np.minimum(column, width - column))
    return np.asarray(view.known & (size >= LEAST_DIAMETER_PX) & inside & (from_frame > EXTENT * reach + 1.0))


def drawn_pixels(view: SliceView, knots: Knots, count: int, rng: np.random.Generator) -> Int64[np.ndarray, "points 2"]:
    """Draw at most `count` usable pixels (row, column), as many from each part of the field as there are."""
    where = np.argwhere(usable_pixels(view))
    if not len(where):
        return where
    chance = _contrast(view.sharp)[where[:, 0], where[:, 1]] * np.abs(view.coc_px)[where[:, 0], where[:, 1]]
    keys = rng.random(len(where)) ** (float(chance.mean()) / np.maximum(chance, 1e-9))
    field = knots.fields_at(view.field_xy(where))
    quota = max(1, count // knots.fields)
    chosen = [mine[np.argsort(-keys[mine])[:quota]] for mine in (np.flatnonzero(field == i) for i in range(knots.fields))]
    return np.asarray(where[np.sort(np.concatenate(chosen))])


def _contrast(sharp: Rgb) -> Plane:
    """Return how much the picture varies around each pixel, over its noise; noise of single pixels is averaged first."""
    grey = cv2.blur(np.ascontiguousarray(sharp.mean(axis=2)), (3, 3))
    mean = cv2.blur(grey, (_CONTRAST_PX, _CONTRAST_PX))
    variance = np.maximum(cv2.blur(grey * grey, (_CONTRAST_PX, _CONTRAST_PX)) - mean**2, 0.0)
    return np.asarray(_LEAST_CONTRAST + np.sqrt(variance / (np.maximum(mean, 0.0) + DARK)))


def equations_of(view: SliceView, where: Int64[np.ndarray, "points 2"], grid: PupilGrid, knots: Knots) -> Equations:
    """Return the equations of pixels (row, column) of a slice."""
    from mrbokeh.lens_measuring.fitting._pupil_rows_numba import gather_rows

    field_xy = view.field_xy(where)
    sums = np.zeros((view.sharp.shape[0] + 1, view.sharp.shape[1] + 1, 3))
    sums[1:, 1:] = view.sharp.astype(np.float64).cumsum(axis=0).cumsum(axis=1)
    rows = np.empty((len(where), 3, len(grid.places)), np.float32)
    gather_rows(rows, sums, view.coc_px, where, knots.turns(field_xy), grid.places, grid.cell)
    mean = rows[..., np.hypot(*grid.places.T) <= 1.0].mean(axis=2)
    seen = view.blurred[where[:, 0], where[:, 1]].astype(np.float64)
    targets, weights = seen - mean, 1.0 / (DARK + np.maximum(mean, 0.0).astype(np.float64))
    return Equations(rows - mean[..., None], targets, weights, knots.at(view.coc_px[where[:, 0], where[:, 1]], field_xy))


@dataclass
class StackSlices:
    """Slices of all stacks, one after the other; pictures that a stack's slices share are kept while it is read. A pair is one slice."""

    stacks: tuple["FocalStack | BlurPair", ...]
    longest: int
    _of_stack: dict[int, tuple[np.ndarray, ...]] = field(default_factory=dict, repr=False)

    @classmethod
    def of(cls, stacks: "Sequence[FocalStack | BlurPair]") -> "StackSlices":
        """Open stacks and pairs. Raises InputError if a stack is not registered, merged and metric."""
        for stack in stacks:
            if not isinstance(stack, FocalStack):
                continue
            if not stack.registered:
                raise InputError(
                    f"{stack.folder} is not registered, so its slices do not lie on its depth: run `mrbokeh capture merge` on it"
                )
            stack.depth_m()
            stack.stated_lens_of(0)
        return cls(tuple(stacks), max((len(stack) for stack in stacks), default=1))

    def __len__(self) -> int:
        return sum(len(stack) for stack in self.stacks)

    @property
    def size(self) -> tuple[int, int]:
        """Return width and height of the first stack."""
        first = self.stacks[0]
        if not isinstance(first, FocalStack):
            return first.size
        height, width = first.depth_m().shape
        return width, height

    def place(self, number: int) -> "tuple[FocalStack | BlurPair, int]":
        """Return the stack and slice of a number."""
        for stack in self.stacks:
            if number < len(stack):
                return stack, number
            number -= len(stack)
        raise IndexError(number)

    def view(self, number: int) -> SliceView:
        stack, index = self.place(number)
        if not isinstance(stack, FocalStack):
            return stack.view
        if id(stack) not in self._of_stack:
            self._of_stack = {id(stack): (stack.all_in_focus(), stack.depth_m(), stack.depth_confidence())}
        sharp, depth_m, confidence = self._of_stack[id(stack)]
        known = known_pixels(confidence, stack.slice_masks(index), stack.exclusions()) & (depth_m > 0.0)
        return SliceView(sharp, stack.slice_rgb(index), smoothed_coc(stack.coc_px(index, depth_m), confidence), known)


def largest_diameter_px(stacks: "Sequence[FocalStack | BlurPair]") -> float:
    """Return the largest circle of confusion of any slice; 0 without stacks."""
    return max((_largest_px(stack) for stack in stacks), default=0.0)


def _largest_px(stack: "FocalStack | BlurPair") -> float:
    if not isinstance(stack, FocalStack):
        return stack.largest_px
    depth_m = stack.depth_m()
    return max(float(np.abs(stack.coc_px(index, depth_m)).max()) for index in range(len(stack)))
