"""Where the corners of one slice lie in another, to a fraction of a pixel."""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float32

from capture.merging.plane_transforms import Transform, inverse, moved
from capture.merging.slice_structure import DetailLevel

_WINDOW_PX = 19
_FIRST_PYRAMID_LEVELS = 1
_FARTHEST_PX = 6.0  # from where the first guess puts a corner
_LARGEST_ROUND_TRIP_PX = 0.15
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)

Points = Float[np.ndarray, "tracks 2"]


@dataclass(frozen=True)
class CornerTracks:
    """The same places in two slices, (0.5, 0.5) at the centre of the first pixel.

    scatter_px: how well a single one is to be trusted.
    """

    target_px: Points
    source_px: Points
    scatter_px: float = 1.0

    def __len__(self) -> int:
        return len(self.target_px)

    def enlarged(self, factor: float) -> "CornerTracks":
        """In pixels that are smaller by a factor."""
        return CornerTracks(self.target_px * factor, self.source_px * factor, self.scatter_px * factor)


def track_corners(target: DetailLevel, source: DetailLevel, target_from_source: Transform, is_first_guess: bool = True) -> CornerTracks:
    """Corners of both slices followed into the other (Lucas and Kanade 1981, Bouguet 2000) and back; what does not return is dropped.

    All in pixels of the level. is_first_guess: the transform may be pixels off. Blur that is the same on all sides of a corner
    does not move it, so that a track is unbiased where depth is even; depth edges shift single tracks, which a robust fit leaves
    out and a correlation of whole pictures cannot.
    """
    levels = _FIRST_PYRAMID_LEVELS if is_first_guess else 0
    there = _followed(target, source, inverse(target_from_source), levels)
    back = _followed(source, target, target_from_source, levels)
    return CornerTracks(np.vstack([there[0], back[1]]), np.vstack([there[1], back[0]]))


def _followed(origin: DetailLevel, goal: DetailLevel, goal_from_origin: Transform, pyramid_levels: int) -> tuple[Points, Points]:
    corners = origin.corners_px
    if not len(corners):
        return np.zeros((0, 2)), np.zeros((0, 2))
    expected = moved(goal_from_origin, corners).astype(np.float32)
    found, ok_there = _lucas_kanade(origin, goal, corners, expected, pyramid_levels)
    returned, ok_back = _lucas_kanade(goal, origin, found, corners, 0)
    near = np.hypot(*(found - expected).T) < _FARTHEST_PX
    kept = ok_there & ok_back & near & (np.hypot(*(returned - corners).T) < _LARGEST_ROUND_TRIP_PX) & _is_usable(goal, found)
    return corners[kept].astype(np.float64), found[kept].astype(np.float64)


def _lucas_kanade(
    origin: DetailLevel,
    goal: DetailLevel,
    points: Float32[np.ndarray, "tracks 2"],
    guess: Float32[np.ndarray, "tracks 2"],
    pyramid_levels: int,
) -> tuple[Float32[np.ndarray, "tracks 2"], Bool[np.ndarray, " tracks"]]:
    half = np.float32(0.5)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        origin.detail, goal.detail, points - half, guess - half,
        winSize=(_WINDOW_PX, _WINDOW_PX), maxLevel=pyramid_levels, criteria=_STOP, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    return found.reshape(-1, 2) + half, status.ravel() > 0


def _is_usable(level: DetailLevel, points: Float32[np.ndarray, "tracks 2"]) -> Bool[np.ndarray, " tracks"]:
    height, width = level.usable.shape
    column, row = np.floor(np.nan_to_num(points, nan=-1.0, posinf=-1.0, neginf=-1.0)).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    return inside & (level.usable[row.clip(0, height - 1), column.clip(0, width - 1)] > 0)
