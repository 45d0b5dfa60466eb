"""Corners of a board in every frame of a clip, read or carried from frames before and after.

Reading is tried in every frame. What cannot be read is carried by flow from the frame before, and where the board is read again
afterwards, back from there; in either case the whole print is laid over the picture, which keeps what is carried from drifting.
"""

from collections.abc import Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.camera_track.tracked_frame import DISTORTION_NAMES, Distortion
from mrbokeh.tracking.charuco.board import CharucoBoard
from mrbokeh.tracking.charuco.board_alignment import aligned_corners
from mrbokeh.tracking.charuco.corner_flow import flow
from mrbokeh.tracking.charuco.detector import NO_CORNERS, CharucoDetector, Corners, Grey
from mrbokeh.tracking.charuco.pose_from_points import FEWEST_POINTS, opencv_matrix
from mrbokeh.video.clip import read_display_frames

_CARRIED_FRAMES = 30
"""So long may corners be carried that no print confirms; real clips blur for less, and flow has slipped by then."""

_BACK_FRAMES = 60


def read_greys(clip: Path, width_px: int, height_px: int) -> Iterator[tuple[Grey, float]]:
    """(grey picture, its time in seconds) of each frame."""
    for frame in read_display_frames(clip, width_px, height_px):
        yield cv2.cvtColor(frame.bgr, cv2.COLOR_BGR2GRAY), frame.time_s


class Undistorting:
    """Pictures of a lens with distortion as its pinhole would have them; a homography then explains a board."""

    def __init__(self, camera: Camera, distortion: Distortion | None) -> None:
        told = opencv_coefficients(distortion)
        self._maps = None
        if told.any():
            matrix, size = opencv_matrix(camera), (camera.width_px, camera.height_px)
            matrix[:2, 2] -= 0.5  # OpenCV's first pixel has its centre at (0, 0)
            self._maps = cv2.initUndistortRectifyMap(matrix, told, None, matrix, size, cv2.CV_32FC1)

    def __call__(self, grey: Grey) -> Grey:
        return grey if self._maps is None else cv2.remap(grey, *self._maps, cv2.INTER_CUBIC)


def opencv_coefficients(distortion: Distortion | None) -> Float64[np.ndarray, "8"]:
    return np.array([(distortion or {}).get(name, 0.0) for name in DISTORTION_NAMES])


class RollingCorners:
    """Corners of frame after frame; `all` mends what went before where the board comes back into sight."""

    def __init__(self, board: CharucoBoard) -> None:
        self._board, self._detector = board, CharucoDetector(board)

    def all(self, greys: Iterable[Grey]) -> list[Corners]:
        """One for each frame; empty where the board is neither seen nor carried."""
        found: list[Corners] = []
        before: Grey | None = None
        waiting: list[Grey] = []
        unconfirmed = 0
        for grey in greys:
            carried = self._carried(before, grey, found[-1]) if before is not None and unconfirmed < _CARRIED_FRAMES else NO_CORNERS
            corners, confirmed = self._in_frame(grey, self._detector.detect(grey), carried)
            found.append(corners)
            unconfirmed = 0 if confirmed else unconfirmed + 1
            if len(corners) < FEWEST_POINTS:
                waiting = [*waiting[-_BACK_FRAMES:], grey]
            elif waiting:
                self._go_back(found, [*waiting, grey])
                waiting = []
            before = grey
        return found

    def _in_frame(self, grey: Grey, read: Corners, carried: Corners) -> tuple[Corners, bool]:
        """(corners, whether reading or the print confirms them)."""
        start = read.with_more(carried)
        aligned = aligned_corners(self._board, grey, start)
        if aligned is not None:
            return aligned, True
        return start, len(read) >= FEWEST_POINTS

    def _go_back(self, found: list[Corners], greys: list[Grey]) -> None:
        """From the last frame, in which the board is seen, to those before, as far as it holds."""
        for back in range(1, len(greys)):
            place = len(found) - 1 - back
            carried = self._carried(greys[-back], greys[-back - 1], found[place + 1])
            corners, _ = self._in_frame(greys[-back - 1], found[place], carried)
            if len(corners) < FEWEST_POINTS:
                return
            found[place] = corners

    def _carried(self, start: Grey, end: Grey, corners: Corners) -> Corners:
        places, good = flow(start, end, corners.xy_px)
        return Corners(corners.ids, places).only(good)
