"""CharucoDetector: finds the corners of a board in a grey picture, with settings for blur and dim light; flow carries them on.

Optical flow is that of Lucas and Kanade 1981 with the pyramids of Bouguet 2001, checked backwards.
"""

from collections import OrderedDict
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from jaxtyping import Bool, Float64, Int64, UInt8

from mrbokeh.tracking.charuco.board import CharucoBoard

_ENLARGED_UP_TO_PX = 640
_FEWEST_MARKERS = 1
_ITERATIONS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
_WINDOW_PX = (2, 15)

Grey = UInt8[np.ndarray, "height width"]
Marker = tuple[int, np.ndarray]


@dataclass(frozen=True)
class Corners:
    """Corners of a board, each id once; xy_px with the centre of the first pixel at (0.5, 0.5)."""

    ids: Int64[np.ndarray, " found"]
    xy_px: Float64[np.ndarray, "found 2"]

    def __len__(self) -> int:
        return len(self.ids)

    def only(self, keep: np.ndarray) -> "Corners":
        return Corners(self.ids[keep], self.xy_px[keep])

    def with_more(self, others: "Corners") -> "Corners":
        """Return these corners and those of others that are not among them."""
        new = others.only(~np.isin(others.ids, self.ids))
        return Corners(np.concatenate([self.ids, new.ids]), np.concatenate([self.xy_px, new.xy_px]))


NO_CORNERS = Corners(np.zeros(0, np.int64), np.zeros((0, 2)))


class CharucoDetector:
    """Detector of a board's corners; one search for markers serves all its grids. Not to be shared between threads."""

    def __init__(self, board: CharucoBoard) -> None:
        self.board = board
        self._markers = cv2.aruco.ArucoDetector(board.opencv_dictionary(), _marker_parameters())
        settings = cv2.aruco.CharucoParameters()
        settings.minMarkers = _FEWEST_MARKERS
        self._grids = [cv2.aruco.CharucoDetector(board.opencv_board(index), settings) for index in range(len(board.grids))]

    def detect(self, grey: Grey) -> Corners:
        """Find corners; small pictures are searched enlarged, because their markers have too few pixels for OpenCV's contours."""
        return self.detect_enlarged(grey, 2 if max(grey.shape) <= _ENLARGED_UP_TO_PX else 1)

    def detect_enlarged(self, grey: Grey, enlarged: int) -> Corners:
        """Find corners, with markers searched in a picture so many times as wide; places are those in the picture given."""
        picture = grey if enlarged == 1 else cv2.resize(grey, None, fx=enlarged, fy=enlarged, interpolation=cv2.INTER_CUBIC)
        corners, ids, _ = self._markers.detectMarkers(picture)
        read = [(int(number), each.reshape(1, 4, 2)) for number, each in zip(np.ravel(ids), corners, strict=True)] if len(corners) else []
        found = NO_CORNERS
        for index, grid in enumerate(self.board.grids):
            markers = [each for each in read if each[0] in grid.marker_ids]
            if markers:
                rough = self._in_grid(picture, index, markers)
                found = found.with_more(
                    _refined(grey, Corners(rough.ids, rough.xy_px / enlarged), self._clear_px(index, markers) / enlarged)
                )
        return found

    def _in_grid(self, picture: Grey, index: int, markers: list[Marker]) -> Corners:
        """Read one grid. OpenCV 5 returns (N, 2) and (N,) where 4.x had (N, 1, 2) and (N, 1); its first pixel has its centre at (0, 0)."""
        ids, corners = np.array([number for number, _ in markers], np.int32), [each for _, each in markers]
        found, found_ids, _, _ = self._grids[index].detectBoard(picture, markerCorners=corners, markerIds=ids)
        if found_ids is None or len(found_ids) == 0:
            return NO_CORNERS
        first = int(np.flatnonzero(self.board.grid_of_corner == index)[0])
        return Corners(np.asarray(found_ids, np.int64).ravel() + first, np.asarray(found, np.float64).reshape(-1, 2) + 0.5)

    def _clear_px(self, index: int, markers: list[Marker]) -> float:
        """Return the distance from a corner to the nearest marker, as the smallest marker that was read shows it."""
        grid = self.board.grids[index]
        side_px = min(float(np.linalg.norm(np.diff(each[0], axis=0, append=each[0, :1]), axis=1).min()) for _, each in markers)
        return side_px / grid.marker_mm * (grid.square_mm - grid.marker_mm) / 2.0


def _refined(grey: Grey, rough: Corners, clear_px: float) -> Corners:
    """Refine saddle points in a window that ends before the markers: OpenCV's own includes them and is pulled towards them.

    The picture is used as it came: enlarged, corners were found 10 to 70 % worse. Corners that were not read are not looked for where a
    pose expects them: beyond the limit of reading, saddle points are so poor that poses with them were three times as far off.
    """
    if not len(rough):
        return rough
    half = int(np.clip(round(clear_px), *_WINDOW_PX))
    places = (rough.xy_px - 0.5).astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(grey, places, (half, half), (-1, -1), _ITERATIONS).reshape(-1, 2)
    return Corners(rough.ids, refined.astype(np.float64) + 0.5)


def _marker_parameters() -> Any:
    """Return OpenCV's parameters with thresholds that a dim and a blurred picture still pass, and more pixels for each bit."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.adaptiveThreshWinSizeMin = 11
    parameters.adaptiveThreshWinSizeMax = 131
    parameters.adaptiveThreshWinSizeStep = 60
    parameters.adaptiveThreshConstant = 3
    parameters.minOtsuStdDev = 2.0
    parameters.polygonalApproxAccuracyRate = 0.05
    parameters.perspectiveRemovePixelPerCell = 8
    parameters.perspectiveRemoveIgnoredMarginPerCell = 0.3
    return parameters


_FLOW_WINDOW_PX = (21, 21)
_LEVELS = 4
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
_FORTH_AND_BACK_PX = 0.7
_REACH_PX = 80

Points = Float64[np.ndarray, "points 2"]


def flow(start: Grey, end: Grey, xy_px: Points) -> tuple[Points, Bool[np.ndarray, " points"]]:
    """Return (places in `end`, which of them can be trusted: those that flow back to within 0.7 px of where they came from)."""
    if len(xy_px) == 0:
        return xy_px, np.zeros(0, bool)
    # OpenCV builds pyramids of whole pictures at every call: only the part around the points is given to it.
    rows, columns, corner_px = _around(xy_px, start.shape)
    one, other = (np.ascontiguousarray(each[rows, columns]) for each in (start, end))
    here = (xy_px - 0.5 - corner_px).astype(np.float32).reshape(-1, 1, 2)
    there, forth, _ = cv2.calcOpticalFlowPyrLK(
        one, other, here, np.empty_like(here), winSize=_FLOW_WINDOW_PX, maxLevel=_LEVELS, criteria=_STOP
    )
    # Back from where it arrived, started at where it came from: a second solution nearby would not return.
    back, returned, _ = cv2.calcOpticalFlowPyrLK(
        other, one, there, here.copy(), winSize=_FLOW_WINDOW_PX, maxLevel=0, criteria=_STOP, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    off_px = np.linalg.norm((back - here).reshape(-1, 2), axis=1)
    places = there.reshape(-1, 2).astype(np.float64) + 0.5 + corner_px
    inside = ((places >= 0) & (places <= start.shape[::-1])).all(axis=1)
    return places, (forth.ravel() == 1) & (returned.ravel() == 1) & (off_px < _FORTH_AND_BACK_PX) & inside


def _around(xy_px: Points, shape: tuple[int, ...]) -> tuple[slice, slice, Float64[np.ndarray, "2"]]:
    """Return (rows, columns, x and y of their first pixel) of the box of the points with a margin for their motion."""
    low = np.maximum(np.floor(xy_px.min(axis=0)).astype(int) - _REACH_PX, 0)
    high = np.minimum(np.ceil(xy_px.max(axis=0)).astype(int) + _REACH_PX, shape[::-1])
    return slice(low[1], high[1]), slice(low[0], high[0]), low.astype(np.float64)


class FrameHistory:
    """Last few frames, by their number; all of one size."""

    def __init__(self, length: int = 8) -> None:
        self._length = length
        self._frames: OrderedDict[int, Grey] = OrderedDict()

    def add(self, sequence: int, grey: Grey) -> bool:
        """Add a frame. Returns whether the frames before are still of use: not if the size changed or the numbers went backwards."""
        newest = next(reversed(self._frames), None)
        goes_on = newest is not None and newest <= sequence and self._frames[newest].shape == grey.shape
        if not goes_on:
            self._frames.clear()
        self._frames[sequence] = grey
        while len(self._frames) > self._length:
            self._frames.popitem(last=False)
        return goes_on

    def carry(self, corners: Corners, sequence: int) -> Corners | None:
        """Carry corners of the frame of that number into the newest frame, hop by hop; None if that frame is not kept any more."""
        if sequence not in self._frames:
            return None
        numbers = [each for each in self._frames if each >= sequence]
        for one, following in pairwise(numbers):
            places, good = flow(self._frames[one], self._frames[following], corners.xy_px)
            corners = Corners(corners.ids, places).only(good)
        return corners

    def from_before(self, corners: Corners) -> Corners:
        """Carry corners of the frame before the newest one into the newest one."""
        numbers = list(self._frames)
        carried = self.carry(corners, numbers[-2]) if len(numbers) > 1 else None
        return NO_CORNERS if carried is None else carried
