"""Corners of a board from all of its print: the drawing is laid over the picture until both agree best.

Read corners start it; then every edge counts, also of markers too blurred to be read. Out of focus this is ten times as exact as
the corners alone: a blurred saddle point is lost in noise, thousands of blurred pixels are not. The measure is the correlation of
Evangelidis and Psarakis (ECC, PAMI 2008), which no change of brightness or contrast moves. It is taken in about linear light:
in display codes a blurred edge lies towards its dark side, which moved poses by 0.5 mm where light leaves 0.1 mm.
"""

from functools import lru_cache

import cv2
import numpy as np
from jaxtyping import Float64, UInt8

from mrbokeh.tracking.charuco.board import CharucoBoard, black_rectangles_mm
from mrbokeh.tracking.charuco.detector import CharucoDetector, Corners, Grey

_FEWEST_CORNERS = 4
_LEAST_CORRELATION = 0.9
"""A hand over a third of the board, or a glare, falls below: then the corners stay as they were read."""

_MOST_PX = 60_000
_SMOOTHED_PX = 5
_FURTHEST_PX = 4.0
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 10, 1e-5)
_SUPERSAMPLED = 4
_MARGIN_SQUARES = 0.4
"""White paper around the print that belongs to the drawing; without it the outer edges would not count."""

_LINEAR = np.round(255.0 * (np.arange(256) / 255.0) ** 2.2).astype(np.uint8)

Homography = Float64[np.ndarray, "3 3"]
Drawing = UInt8[np.ndarray, "drawn_height drawn_width"]


class AlignedDetector:
    """CharucoDetector whose corners are aligned with the whole print if that is seen. Not to be shared between threads."""

    def __init__(self, board: CharucoBoard) -> None:
        self._detector, self._board = CharucoDetector(board), board

    def detect(self, grey: Grey) -> Corners:
        read = self._detector.detect(grey)
        aligned = aligned_corners(self._board, grey, read)
        return read if aligned is None else aligned


def aligned_corners(board: CharucoBoard, grey: Grey, read: Corners) -> Corners | None:
    """Return all corners of the board that lie in the picture; None if too few were read to begin with or the print does not fit."""
    picture_from_board = _from_corners(board, read)
    if picture_from_board is None:
        return None
    scale = _scale(board, picture_from_board)
    # Of millimetres into pixels of the drawing, whose first pixel has its centre at (0, 0) as OpenCV has it.
    edge = scale * _margin_mm(board) - 0.5
    drawing_from_board = np.array([[scale, 0.0, edge], [0.0, scale, edge], [0.0, 0.0, 1.0]])
    found = _laid_over(_drawing(board, scale), cv2.LUT(grey, _LINEAR), picture_from_board @ np.linalg.inv(drawing_from_board))
    return None if found is None else _checked(board, grey, read, found @ drawing_from_board)


def _laid_over(drawing: Drawing, picture: Grey, start: Homography) -> Homography | None:
    """Return the homography to the picture from the drawing; None if they do not agree."""
    try:
        fit, found = cv2.findTransformECC(
            drawing,
            picture,
            (start / start[2, 2]).astype(np.float32),
            cv2.MOTION_HOMOGRAPHY,
            _STOP,
            np.full_like(picture, 255),
            _SMOOTHED_PX,
        )
    except cv2.error:
        # It did not converge.
        return None
    return np.asarray(found, np.float64) if fit > _LEAST_CORRELATION else None


def _margin_mm(board: CharucoBoard) -> float:
    return _MARGIN_SQUARES * min(grid.square_mm for grid in board.grids)


def _from_corners(board: CharucoBoard, read: Corners) -> Homography | None:
    """Return the homography to the picture (OpenCV's pixels) from millimetres on the board."""
    if len(read) < _FEWEST_CORNERS:
        return None
    found, _ = cv2.findHomography(1000.0 * board.corners_m[read.ids, :2], read.xy_px - 0.5, cv2.USAC_MAGSAC, 2.0)
    return None if found is None or not np.isfinite(found).all() or abs(np.linalg.det(found)) < 1e-12 else np.asarray(found, np.float64)


def _checked(board: CharucoBoard, grey: Grey, read: Corners, picture_from_board: Homography) -> Corners | None:
    """Return the corners; None if what was read lies elsewhere, for the print may have slid by a square."""
    height, width = grey.shape
    xy_px = _through(picture_from_board, 1000.0 * board.corners_m[:, :2]) + 0.5
    if not np.median(np.linalg.norm(xy_px[read.ids] - read.xy_px, axis=1)) < _FURTHEST_PX:
        return None
    inside = np.all((xy_px > 0) & (xy_px < (width, height)), axis=1)
    return Corners(np.flatnonzero(inside), xy_px[inside])


def _through(homography: Homography, xy: Float64[np.ndarray, "points 2"]) -> Float64[np.ndarray, "points 2"]:
    mapped = np.column_stack([xy, np.ones(len(xy))]) @ homography.T
    return mapped[:, :2] / mapped[:, 2:]


def _scale(board: CharucoBoard, picture_from_board: Homography) -> float:
    """Return pixels of the drawing per millimetre: about as many as in the picture, in steps of sqrt(2), within the time allowed."""
    width, height = board.size_mm
    outline = _through(picture_from_board, np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]]))
    seen = np.sqrt(cv2.contourArea(outline.astype(np.float32)) / (width * height))
    most = np.sqrt(_MOST_PX / (width * height))
    return float(2.0 ** (np.floor(2.0 * np.log2(np.clip(seen, most / 16.0, most))) / 2.0))


@lru_cache(maxsize=8)
def _drawing(board: CharucoBoard, px_per_mm: float) -> Drawing:
    """Draw the print with its margin, black 0 and white 255, each pixel the mean of 16."""
    margin_mm = _margin_mm(board)
    size_px = [int(np.ceil((side + 2 * margin_mm) * px_per_mm)) for side in board.size_mm]
    fine = np.full((size_px[1] * _SUPERSAMPLED, size_px[0] * _SUPERSAMPLED), 255, np.uint8)
    rectangles = (black_rectangles_mm(board) + np.array([margin_mm, margin_mm, 0.0, 0.0])) * px_per_mm * _SUPERSAMPLED
    edges = np.concatenate([rectangles[:, :2], rectangles[:, :2] + rectangles[:, 2:]], axis=1).round().astype(int)
    for left, top, right, bottom in edges:
        fine[top:bottom, left:right] = 0
    return cv2.resize(fine, size_px, interpolation=cv2.INTER_AREA)
