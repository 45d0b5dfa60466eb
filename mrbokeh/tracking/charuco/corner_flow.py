"""Corners carried from frame to frame by optical flow (Lucas and Kanade 1981, pyramids of Bouguet 2001), checked backwards."""

from collections import OrderedDict
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import Bool, Float64

from mrbokeh.tracking.charuco.detector import NO_CORNERS, Corners, Grey

_WINDOW_PX = (21, 21)
_LEVELS = 4
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
_FORTH_AND_BACK_PX = 0.7
_REACH_PX = 80

Points = Float64[np.ndarray, "points 2"]


def flow(start: Grey, end: Grey, xy_px: Points) -> tuple[Points, Bool[np.ndarray, " points"]]:
    """(places in `end`, which of them are to be trusted: those that flow back to within 0.7 px of where they came from)."""
    if len(xy_px) == 0:
        return xy_px, np.zeros(0, bool)
    # OpenCV builds pyramids of whole pictures at every call: only the part around the points is given to it.
    rows, columns, corner_px = _around(xy_px, start.shape)
    one, other = (np.ascontiguousarray(each[rows, columns]) for each in (start, end))
    here = (xy_px - 0.5 - corner_px).astype(np.float32).reshape(-1, 1, 2)
    there, forth, _ = cv2.calcOpticalFlowPyrLK(one, other, here, np.empty_like(here), winSize=_WINDOW_PX, maxLevel=_LEVELS, criteria=_STOP)
    # Back from where it arrived, started at where it came from: a second solution nearby would not return.
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        other, one, there, here.copy(), winSize=_WINDOW_PX, maxLevel=0, criteria=_STOP, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    off_px = np.linalg.norm((back - here).reshape(-1, 2), axis=1)
    places = there.reshape(-1, 2).astype(np.float64) + 0.5 + corner_px
    inside = ((places >= 0) & (places <= start.shape[::-1])).all(axis=1)
    return places, (forth.ravel() == 1) & (returned.ravel() == 1) & (off_px < _FORTH_AND_BACK_PX) & inside


def _around(xy_px: Points, shape: tuple[int, ...]) -> tuple[slice, slice, Float64[np.ndarray, "2"]]:
    """(rows, columns, x and y of their first pixel) of the box of the points with a margin for their motion."""
    low = np.maximum(np.floor(xy_px.min(axis=0)).astype(int) - _REACH_PX, 0)
    high = np.minimum(np.ceil(xy_px.max(axis=0)).astype(int) + _REACH_PX, shape[::-1])
    return slice(low[1], high[1]), slice(low[0], high[0]), low.astype(np.float64)


class FrameHistory:
    """The last few frames, by their number; all of one size."""

    def __init__(self, length: int = 8) -> None:
        self._length = length
        self._frames: OrderedDict[int, Grey] = OrderedDict()

    def add(self, sequence: int, grey: Grey) -> bool:
        """Whether the frames before are still of use: not so when the size changed or the numbers went backwards."""
        newest = next(reversed(self._frames), None)
        goes_on = newest is not None and newest <= sequence and self._frames[newest].shape == grey.shape
        if not goes_on:
            self._frames.clear()
        self._frames[sequence] = grey
        while len(self._frames) > self._length:
            self._frames.popitem(last=False)
        return goes_on

    def carry(self, corners: Corners, sequence: int) -> Corners | None:
        """Corners of the frame of that number, in the newest frame, hop by hop; None if that frame is not kept any more."""
        if sequence not in self._frames:
            return None
        numbers = [each for each in self._frames if each >= sequence]
        for one, following in pairwise(numbers):
            places, good = flow(self._frames[one], self._frames[following], corners.xy_px)
            corners = Corners(corners.ids, places).only(good)
        return corners

    def from_before(self, corners: Corners) -> Corners:
        """Corners of the frame before the newest one, in the newest one."""
        numbers = list(self._frames)
        carried = self.carry(corners, numbers[-2]) if len(numbers) > 1 else None
        return NO_CORNERS if carried is None else carried
