"""Equations of slices and blurred pictures: pixels whose blur is known well enough to tell the shape of the kernel.

Counted are pixels with a trusted depth, not clipped, and far from every edge of depth by more than light travels there: around edges, what
is hidden and what hides mix, which a kernel cannot explain. Among them those are drawn (weighted sampling without replacement, Efraimidis
and Spirakis 2006) that see contrast, evenly over the field.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float32, Float64, Int64
from scipy.ndimage import distance_transform_edt

from mrbokeh.lens_measuring.fitting.evidence import DARK, Equations, Knots
from mrbokeh.lens_measuring.fitting.pupil_picture import EXTENT, PupilGrid

LEAST_DIAMETER_PX = 3.0
"""Smaller kernels are a few pixels and say little about their shape."""

LEAST_CONFIDENCE = 0.1
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


def smoothed_coc(coc_px: Plane, confidence: Plane) -> Plane:
    """Remove the noise of single pixels from a map of diameters, keeping its edges.

    What is thin (a light in front of a wall, a wire) keeps its own diameter if its depth is trusted: lost to its surroundings its light
    would be taken for theirs, and one light outshines all that tells of the kernel there.
    """
    smooth = cv2.medianBlur(np.ascontiguousarray(coc_px), 5)
    thin = (np.abs(coc_px - smooth) > _jump_px(coc_px)) & (confidence >= LEAST_CONFIDENCE)
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
    return np.asarray(view.known & (size >= LEAST_DIAMETER_PX) & inside & (from_frame_px(size.shape) > EXTENT * reach + 1.0))


def from_frame_px(size: tuple[int, ...]) -> Float64[np.ndarray, "height width"]:
    """Return how far the middle of each pixel of a picture (height, width) is from the frame."""
    row, column = (np.minimum(each, each[::-1]) for each in (np.arange(length) + 0.5 for length in size))
    return np.minimum(row[:, None], column)


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
