"""Straight segments of a picture, in coordinates that do not depend on its size."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Float32, Float64, UInt8

from mrbokeh.images.color import display_rgb8, luminance

WORKING_PX = 1600
"""Long side of the copy in which segments are found; smaller pictures are taken as they are."""
_SHORTEST = 0.018
"""Shortest segment, as a part of the long side."""
_MOST = 700
POINT_NOISE = 0.6 / WORKING_PX
BENDING_RAD = 0.003
"""What makes a segment's direction uncertain: noise of its ends, and lens distortion or edges that are not quite straight."""

Points = Float64[np.ndarray, "segments 2"]


@dataclass(frozen=True)
class Segments:
    """Straight segments. Coordinates are counted from the middle of the picture, x right, y down, in long sides of the picture.

    start, end: (N, 2) end points.
    """

    start: Points
    end: Points

    def __len__(self) -> int:
        return len(self.start)

    @cached_property
    def middle(self) -> Points:
        return 0.5 * (self.start + self.end)

    @cached_property
    def length(self) -> Float64[np.ndarray, " segments"]:
        return np.hypot(*(self.end - self.start).T)

    @cached_property
    def along(self) -> Points:
        """Return (N, 2) unit directions."""
        return (self.end - self.start) / self.length[:, None]

    @cached_property
    def lines(self) -> Float64[np.ndarray, "segments 3"]:
        """Return (N, 3) homogeneous lines through the segments, normals of length 1."""
        normal = np.stack([-self.along[:, 1], self.along[:, 0]], axis=1)
        return np.concatenate([normal, -(normal * self.middle).sum(axis=1, keepdims=True)], axis=1)

    @cached_property
    def sigma_rad(self) -> Float64[np.ndarray, " segments"]:
        """Return the standard deviation of each segment's direction."""
        return np.hypot(2.0 * POINT_NOISE / self.length, BENDING_RAD)

    def chosen(self, which: Bool[np.ndarray, " segments"] | np.ndarray) -> "Segments":
        return Segments(self.start[which], self.end[which])

    def joined(self, other: "Segments") -> "Segments":
        return Segments(np.concatenate([self.start, other.start]), np.concatenate([self.end, other.end]))

    def straightened(self, bending: float) -> "Segments":
        """Return the segments without a lens's distortion: a point at m is seen at about m (1 + bending m.m)."""
        return Segments(*(ends[0] for ends in self.straight(np.array([bending]))))

    def straight(self, bending: Float64[np.ndarray, " tries"]) -> tuple[Float64[np.ndarray, "tries segments 2"], ...]:
        """Return the starts and the ends of the segments without each of several distortions."""
        return tuple(each * (1.0 - bending[:, None, None] * (each**2).sum(axis=1)[:, None]) for each in (self.start, self.end))

    def in_pixels(self, width_px: int, height_px: int) -> Float64[np.ndarray, "segments 4"]:
        """Return (N, 4): x and y of both ends in pixels of a picture of that size."""
        middle, side_px = np.array([width_px, height_px]) / 2.0, max(width_px, height_px)
        return np.concatenate([self.start * side_px + middle, self.end * side_px + middle], axis=1)


def segments_from_pixels(ends_px: Float[np.ndarray, "segments 4"], width_px: int, height_px: int) -> Segments:
    """Return segments from x and y of both ends in pixels of a picture of that size."""
    middle, side_px = np.array([width_px, height_px]) / 2.0, max(width_px, height_px)
    ends = np.asarray(ends_px, np.float64).reshape(-1, 4)
    return Segments((ends[:, :2] - middle) / side_px, (ends[:, 2:] - middle) / side_px)


def working_copy(rgb: Float32[np.ndarray, "height width 3"]) -> UInt8[np.ndarray, "small_height small_width"]:
    """Return the luminance of a scene-linear picture, encoded for display, at most 1600 px long."""
    import cv2

    height_px, width_px = rgb.shape[:2]
    shrink = min(1.0, WORKING_PX / max(height_px, width_px))
    size_px = (max(1, round(width_px * shrink)), max(1, round(height_px * shrink)))
    small = cv2.resize(rgb, size_px, interpolation=cv2.INTER_AREA) if shrink < 1.0 else rgb
    grey = luminance(np.clip(np.nan_to_num(small), 0.0, 1.0)).astype(np.float32)
    return display_rgb8(grey)


def find_segments(grey: UInt8[np.ndarray, "height width"]) -> Segments:
    """Find the longest straight segments of a picture by LSD (von Gioi and others, 2010), at most 700."""
    import cv2

    height_px, width_px = grey.shape
    found = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    if found is None:
        return Segments(np.zeros((0, 2)), np.zeros((0, 2)))
    # OpenCV's pixel centres are whole numbers.
    segments = segments_from_pixels(found.reshape(-1, 4) + 0.5, width_px, height_px)
    segments = segments.chosen(segments.length >= _SHORTEST)
    return segments.chosen(np.argsort(-segments.length, kind="stable")[:_MOST])
