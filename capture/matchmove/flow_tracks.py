"""Features followed through all frames of a clip by optical flow, new ones wherever the picture has none."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64

from mrbokeh.tracking.charuco.detector import Grey, flow

_MOST = 800
_APART_SHARE = 1 / 64
"""Of the picture's width, between a new feature and all others."""

_REFILLED_BELOW = 0.9
_QUALITY, _CORNER_PX = 0.003, 5
_EDGE_PX = 3.0


@dataclass(frozen=True)
class FlowTracks:
    """Places of features: one row for each feature in each frame, frame after frame. size_px: (width, height) of the pictures."""

    frames: Int64[np.ndarray, " seen"]
    features: Int64[np.ndarray, " seen"]
    xy_px: Float64[np.ndarray, "seen 2"]
    size_px: tuple[int, int]
    frame_count: int

    def among(self, frames: np.ndarray, fewest: int) -> "FlowTracks":
        """Return the rows of these frames with features that `fewest` of them see or more."""
        rows = np.isin(self.frames, frames)
        often = np.bincount(self.features[rows], minlength=int(self.features.max(initial=0)) + 1)
        rows &= often[self.features] >= fewest
        return self.only(rows)

    def only(self, rows: Bool[np.ndarray, " seen"]) -> "FlowTracks":
        return replace(self, frames=self.frames[rows], features=self.features[rows], xy_px=self.xy_px[rows])

    def resized(self, width_px: int, height_px: int) -> "FlowTracks":
        """Return the same tracks in pictures of another size."""
        factors = np.array([width_px, height_px]) / np.array(self.size_px)
        return replace(self, xy_px=self.xy_px * factors, size_px=(width_px, height_px))

    def common(self, one: int, other: int) -> tuple[Float64[np.ndarray, "both 2"], Float64[np.ndarray, "both 2"]]:
        """Return where both frames see the features that they have in common."""
        in_one, in_other = (np.flatnonzero(self.frames == each) for each in (one, other))
        _, first, second = np.intersect1d(self.features[in_one], self.features[in_other], return_indices=True)
        return self.xy_px[in_one[first]], self.xy_px[in_other[second]]


def followed(greys: Iterable[Grey], size_px: tuple[int, int]) -> FlowTracks:
    """Follow features through pictures of size_px (width, height)."""
    before: Grey | None = None
    features, xy_px, known = np.zeros(0, np.int64), np.zeros((0, 2)), 0
    frames: list[tuple[np.ndarray, np.ndarray]] = []
    for grey in greys:
        if before is not None:
            there, good = flow(before, grey, xy_px)
            good &= ((there > _EDGE_PX) & (there < np.array(size_px) - _EDGE_PX)).all(axis=1)
            features, xy_px = features[good], there[good]
        if len(features) < _REFILLED_BELOW * _MOST:
            new_px = _new_features(grey, xy_px)
            features = np.concatenate([features, np.arange(known, known + len(new_px))])
            xy_px, known = np.concatenate([xy_px, new_px]), known + len(new_px)
        frames.append((features, xy_px))
        before = grey
    return FlowTracks(
        frames=np.repeat(np.arange(len(frames)), [len(each) for each, _ in frames]),
        features=np.concatenate([each for each, _ in frames]).astype(np.int64),
        xy_px=np.concatenate([each for _, each in frames]),
        size_px=size_px,
        frame_count=len(frames),
    )


def _new_features(grey: Grey, taken_px: np.ndarray) -> Float64[np.ndarray, "new 2"]:
    apart_px = max(8, round(_APART_SHARE * grey.shape[1]))
    free = np.full(grey.shape, 255, np.uint8)
    for x, y in taken_px:
        cv2.circle(free, (int(x), int(y)), apart_px, 0, -1)
    found = cv2.goodFeaturesToTrack(grey, _MOST - len(taken_px), _QUALITY, apart_px, mask=free, blockSize=_CORNER_PX)
    return np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64) + 0.5
