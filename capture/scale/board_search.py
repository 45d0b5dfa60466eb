"""The corners of a board in photographs, where there is time to search more than once."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import UInt8

from mrbokeh.tracking.charuco.board import CharucoBoard
from mrbokeh.tracking.charuco.detector import CharucoDetector, Corners

_ENLARGED_UP_TO_PX = 2000


class BoardSearch:
    """Takes the board as printed by OpenCV before and since 4.6: nobody knows which version made a print.

    The whole print is not laid over the picture (mrbokeh.tracking.charuco.board_alignment). On a traced board with white paper around it
    that took the corners' error from 0.070 to 0.016 px and their share of the scale's from 0.02 to 0.004 %, where poses leave 0.05 %;
    but its homography knows no distortion, which photographs keep here, and a board cut off at its squares does not fit.
    """

    def __init__(self, board: CharucoBoard) -> None:
        self._detectors = [CharucoDetector(replace(board, legacy=legacy)) for legacy in (board.legacy, not board.legacy)]

    def corners(self, rgb8: UInt8[np.ndarray, "height width 3"]) -> Corners:
        """The search that found most. Small pictures are also searched enlarged: small markers are read there that were not before."""
        grey = cv2.cvtColor(np.ascontiguousarray(rgb8), cv2.COLOR_RGB2GRAY)
        scales = (1, 2) if max(grey.shape) <= _ENLARGED_UP_TO_PX else (1,)
        return max((each.detect_enlarged(grey, enlarged) for enlarged in scales for each in self._detectors), key=len)
