"""The camera of a clip from the board that it shows (Zhang 2000, by OpenCV), with no more parameters than the views support."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.track import Distortion
from mrbokeh.tracking.charuco.detector import Corners
from mrbokeh.tracking.charuco.flat_prints import FlatPrint

FEWEST_CORNERS = 8
"""Corners that a frame must show."""

_FEWEST_VIEWS = 4
_MOST_VIEWS = 40
_WORST_FOCAL = 0.03
_WORST_PRINCIPAL = 0.02
_PROBES = (0.9, 1.1)

_ALL_FIXED = cv2.CALIB_ZERO_TANGENT_DIST | cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_FIX_PRINCIPAL_POINT
_FREED = (
    (),
    (cv2.CALIB_FIX_K1,),
    (cv2.CALIB_FIX_K1, cv2.CALIB_FIX_K2),
    (cv2.CALIB_FIX_K1, cv2.CALIB_FIX_K2, cv2.CALIB_FIX_PRINCIPAL_POINT),
)
_PARAMETERS = (1, 2, 3, 5)
_WORST_PX, _WORST_SHARE = 2.0, 0.002
"""RMS of corners of a blurred, hand-held board is below 1 px at 1920 px; of another board it is above 10."""


@dataclass(frozen=True)
class Calibration:
    """Calibrated camera of a clip.

    camera: without a pose. focal_sigma: of the focal length, as a share. residual_px: RMS over all corners of the views used.
    """

    camera: Camera
    distortion: Distortion
    focal_sigma: float
    residual_px: float
    views: int


def calibrated(board: FlatPrint, seen: Sequence[Corners], width_px: int, height_px: int) -> Calibration:
    """Calibrate a camera from the corners of a board in the frames of a clip.

    seen: corners as read in frames of that size, not aligned with the print, whose homography would hide distortion.

    Square pixels; then in turn k1, k2 and the principal point are freed where Schwarz's criterion (BIC 1978) says that the views know
    them. Raises InputError where they leave the focal length open.
    """
    views = _spread([each for each in seen if len(each) >= FEWEST_CORNERS], board)
    if len(views) < _FEWEST_VIEWS:
        raise InputError(
            f"only {len(views)} frames show {FEWEST_CORNERS} corners of the board, too few to calibrate by: give --camera, "
            f"or film the board nearer and from several sides, or print one of more squares (this one has {len(board.corners_m)} corners)"
        )
    solutions = [_solved(board, views, (width_px, height_px), index) for index in range(len(_FREED))]
    best = min((each for each in solutions if each is not None), key=lambda each: each[0], default=None)
    if best is None:
        raise InputError(
            "the clip shows the board under too few angles to tell the focal length: tilt the camera by 20 degrees or more "
            "against the board, or give --camera"
        )
    if (off_px := best[1].residual_px) > max(_WORST_PX, _WORST_SHARE * width_px):
        raise InputError(
            f"no camera explains where the corners are seen, they are off by {off_px:.1f} px: is this the board in the clip? "
            f"Compare its squares and markers with the print, or give --camera"
        )
    return best[1]


def _solved(board: FlatPrint, views: Sequence[Corners], size_px: tuple[int, int], freed: int) -> tuple[float, Calibration] | None:
    """Return (Schwarz's criterion, calibration); None if a parameter is left open."""
    points = [board.corners_m[each.ids].astype(np.float32) for each in views]
    pixels = [(each.xy_px - 0.5).astype(np.float32).reshape(-1, 1, 2) for each in views]
    start = np.array([[max(size_px), 0.0, size_px[0] / 2 - 0.5], [0.0, max(size_px), size_px[1] / 2 - 0.5], [0.0, 0.0, 1.0]])
    flags = _ALL_FIXED & ~sum(_FREED[freed]) | cv2.CALIB_USE_INTRINSIC_GUESS | cv2.CALIB_FIX_ASPECT_RATIO
    try:
        found = cv2.calibrateCameraExtended(points, pixels, size_px, start, np.zeros(5), flags=flags)
    except cv2.error:
        return None
    rms_px, matrix, coefficients, sigmas = found[0], found[1], np.ravel(found[2]), np.ravel(found[5])
    focal_px, count = float(matrix[0, 0]), 2 * sum(map(len, views))
    if focal_px <= 0.0 or max(sigmas[2:4]) > _WORST_PRINCIPAL * max(size_px):
        return None
    others_px = [_rms_px(points, pixels, size_px, matrix * _scaled(factor), coefficients, flags) for factor in _PROBES]
    focal_sigma = _focal_sigma(rms_px, others_px, count)
    if focal_sigma > _WORST_FOCAL:
        return None
    camera = Camera(*size_px, (focal_px, focal_px), (float(matrix[0, 2]) + 0.5, float(matrix[1, 2]) + 0.5))
    distortion = {name: float(value) for name, value in zip(("k1", "k2"), coefficients[:2], strict=True) if value}
    criterion = count * np.log(rms_px**2) + _PARAMETERS[freed] * np.log(count)
    return float(criterion), Calibration(
        camera=camera, distortion=distortion, focal_sigma=focal_sigma, residual_px=float(rms_px), views=len(views)
    )


def _scaled(factor: float) -> Float64[np.ndarray, "3 3"]:
    return np.array([[factor, 1.0, 1.0], [1.0, factor, 1.0], [1.0, 1.0, 1.0]])


def _rms_px(
    points: list[np.ndarray], pixels: list[np.ndarray], size_px: tuple[int, int], matrix: np.ndarray, coefficients: np.ndarray, flags: int
) -> float:
    """Return the RMS that remains with that focal length, everything else fitted anew."""
    fixed = flags | cv2.CALIB_FIX_FOCAL_LENGTH
    return float(cv2.calibrateCamera(points, pixels, size_px, matrix, coefficients.copy(), flags=fixed)[0])


def _focal_sigma(rms_px: float, others_px: list[float], count: int) -> float:
    """Return the relative error of the focal length, from how much worse values a tenth shorter and longer fit (a likelihood profile).

    OpenCV's own uncertainty is a billionth where a board is only seen head on.
    """
    worse = min(count * (other_px**2 / rms_px**2 - 1.0) for other_px in others_px)
    return abs(_PROBES[1] - 1.0) / float(np.sqrt(worse)) if worse > 0.0 else np.inf


def _spread(seen: Sequence[Corners], board: FlatPrint) -> list[Corners]:
    """Return up to 40 views that differ most in where they see the board's outline, each time the farthest from those taken."""
    if len(seen) <= _MOST_VIEWS:
        return list(seen)
    outlines = np.array([_outline_px(each, board) for each in seen])
    taken = [int(np.argmax([len(each) for each in seen]))]
    apart = np.full(len(seen), np.inf)
    while len(taken) < _MOST_VIEWS:
        apart = np.minimum(apart, np.linalg.norm(outlines - outlines[taken[-1]], axis=1))
        taken.append(int(np.argmax(apart)))
    return [seen[index] for index in taken]


def _outline_px(corners: Corners, board: FlatPrint) -> Float64[np.ndarray, "8"]:
    """Return where the board's four outer corners lie; 0 if the view does not tell."""
    homography, _ = cv2.findHomography(1000.0 * board.corners_m[corners.ids, :2], corners.xy_px, cv2.USAC_MAGSAC, 2.0)
    if homography is None:
        return np.zeros(8)
    width, height = board.size_mm
    ends = np.array([[0.0, 0.0, 1.0], [width, 0.0, 1.0], [width, height, 1.0], [0.0, height, 1.0]]) @ homography.T
    return np.asarray(ends[:, :2] / ends[:, 2:], np.float64).ravel()
