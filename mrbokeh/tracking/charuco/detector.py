"""Finds the corners of a board in a grey picture, with settings for blur and dim light."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float64, Int64, UInt8

from mrbokeh.tracking.charuco.board import CharucoBoard

_ENLARGED_UP_TO_PX = 640
_FEWEST_MARKERS = 1
_ITERATIONS = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 40, 1e-3)
_WINDOW_PX = (2, 15)

Grey = UInt8[np.ndarray, "height width"]
Marker = tuple[int, np.ndarray]


@dataclass(frozen=True)
class Corners:
    """ids: of the board's corners, each once. xy_px: where they are, the centre of the first pixel at (0.5, 0.5)."""

    ids: Int64[np.ndarray, " found"]
    xy_px: Float64[np.ndarray, "found 2"]

    def __len__(self) -> int:
        return len(self.ids)

    def only(self, keep: np.ndarray) -> "Corners":
        return Corners(self.ids[keep], self.xy_px[keep])

    def with_more(self, others: "Corners") -> "Corners":
        """These, and of the others those that are not among them."""
        new = others.only(~np.isin(others.ids, self.ids))
        return Corners(np.concatenate([self.ids, new.ids]), np.concatenate([self.xy_px, new.xy_px]))


NO_CORNERS = Corners(np.zeros(0, np.int64), np.zeros((0, 2)))


class CharucoDetector:
    """One search for markers serves all grids of the board. Not to be shared between threads."""

    def __init__(self, board: CharucoBoard) -> None:
        self.board = board
        self._markers = cv2.aruco.ArucoDetector(board.opencv_dictionary(), _marker_parameters())
        settings = cv2.aruco.CharucoParameters()
        settings.minMarkers = _FEWEST_MARKERS
        self._grids = [cv2.aruco.CharucoDetector(board.opencv_board(index), settings) for index in range(len(board.grids))]

    def detect(self, grey: Grey) -> Corners:
        """Small pictures are searched enlarged: their markers have too few pixels for OpenCV's contours."""
        return self.detect_enlarged(grey, 2 if max(grey.shape) <= _ENLARGED_UP_TO_PX else 1)

    def detect_enlarged(self, grey: Grey, enlarged: int) -> Corners:
        """The same with markers searched in a picture so many times as wide; places are always those in the picture given."""
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
        """OpenCV 5 returns (N, 2) and (N,) where 4.x had (N, 1, 2) and (N, 1); its first pixel has its centre at (0, 0)."""
        ids, corners = np.array([number for number, _ in markers], np.int32), [each for _, each in markers]
        found, found_ids, _, _ = self._grids[index].detectBoard(picture, markerCorners=corners, markerIds=ids)
        if found_ids is None or len(found_ids) == 0:
            return NO_CORNERS
        first = int(np.flatnonzero(self.board.grid_of_corner == index)[0])
        return Corners(np.asarray(found_ids, np.int64).ravel() + first, np.asarray(found, np.float64).reshape(-1, 2) + 0.5)

    def _clear_px(self, index: int, markers: list[Marker]) -> float:
        """From a corner to the nearest marker, as the smallest marker that was read shows it."""
        grid = self.board.grids[index]
        side_px = min(float(np.linalg.norm(np.diff(each[0], axis=0, append=each[0, :1]), axis=1).min()) for _, each in markers)
        return side_px / grid.marker_mm * (grid.square_mm - grid.marker_mm) / 2.0


def _refined(grey: Grey, rough: Corners, clear_px: float) -> Corners:
    """Saddle points anew in a window that ends before the markers: OpenCV's own takes them in and is pulled towards them.

    In the picture as it came: enlarged, they were found 10 to 70 % worse. Corners that were not read are not looked for where a
    pose expects them: beyond the limit of reading, saddle points are so poor that poses with them were three times as far off.
    """
    if not len(rough):
        return rough
    half = int(np.clip(round(clear_px), *_WINDOW_PX))
    places = (rough.xy_px - 0.5).astype(np.float32).reshape(-1, 1, 2)
    refined = cv2.cornerSubPix(grey, places, (half, half), (-1, -1), _ITERATIONS).reshape(-1, 2)
    return Corners(rough.ids, refined.astype(np.float64) + 0.5)


def _marker_parameters() -> Any:
    """What differs from OpenCV's: thresholds that a dim and a blurred picture still pass, more pixels for each bit."""
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
