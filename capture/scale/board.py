"""The scale from a ChArUco board: its corners triangulated with the poses, then a similarity fitted to their pictures."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from capture.poses.cauchy_loss import MEDIAN_OF_RAYLEIGH
from capture.poses.sparse_model import SparseModel, SparseView
from capture.scale.answer import ScaleAnswer
from mrbokeh.distortion.radial import undistorted_px
from mrbokeh.optics.lens import MM_PER_M
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid, read_board
from mrbokeh.tracking.charuco.detector import CharucoDetector, Corners

_ENLARGED_UP_TO_PX = 2000
FEWEST_CORNERS = 6
POSES_SIGMA, POSES_SIGMA_WITH_DISTORTION = 5e-4, 1e-3
"""Error of the scale that poses and lens cause and residuals of the corners do not show: 0.00 to 0.04 % on traced scenes where the lens
has no distortion and none is fitted; 0.12 and 0.16 % where its distortion has to be found too. That is noise of the matches: 0.1 px on 500
points of the lab's seven views leave 0.09 % root mean square when a term of distortion is fitted, and 0.06 % when none is.
"""
_WRONG_SIGMAS = 5.0
_LEAST_WRONG_PX = 0.1
Points = Float[np.ndarray, "points 3"]


@dataclass(frozen=True)
class BoardDetections:
    """Corners of the board seen in the views: index of the view, id of the corner, position in the picture."""

    views: Int[np.ndarray, " seen"]
    corners: Int[np.ndarray, " seen"]
    xy_px: Float[np.ndarray, "seen 2"]

    def only(self, keep: np.ndarray) -> "BoardDetections":
        return BoardDetections(self.views[keep], self.corners[keep], self.xy_px[keep])


@dataclass(frozen=True)
class Similarity:
    """The similarity y = scale * rotation @ x + translation."""

    scale: float
    rotation: Float[np.ndarray, "3 3"]
    translation: Float[np.ndarray, "3"]

    def __call__(self, points: Points) -> Points:
        return self.scale * points @ self.rotation.T + self.translation


def board_scale(model: SparseModel, board: CharucoBoard, pictures: Iterator[UInt8[np.ndarray, "_ _ 3"]]) -> ScaleAnswer:
    """Return the scale by a board. pictures: 8-bit RGB, one for each view of the model, in its order and with its intrinsics."""
    return scale_of_detections(model, board, detect_board(board, pictures))


def detect_board(board: CharucoBoard, pictures: Iterator[UInt8[np.ndarray, "_ _ 3"]]) -> BoardDetections:
    search = BoardSearch(board)
    found = [search.corners(picture) for picture in pictures]
    views = np.concatenate([np.full(len(each), index, np.int64) for index, each in enumerate(found)])
    return BoardDetections(views, np.concatenate([each.ids for each in found]), np.concatenate([each.xy_px for each in found]))


def scale_of_detections(model: SparseModel, board: CharucoBoard, seen: BoardDetections) -> ScaleAnswer:
    """Fit a similarity to the triangulated corners (Umeyama 1991), then refine it on the pixels, where all have the same noise."""
    seen = seen.only(_seen_twice(seen))
    corners = np.unique(seen.corners)
    if len(corners) < FEWEST_CORNERS:
        raise InputError(
            f"looked for a ChArUco board of {board.squares_text} squares ({board.dictionary}) in {len(model.views)} views "
            f"and found {len(corners)} corners seen by two or more, but {FEWEST_CORNERS} are needed: check --board, --dictionary and "
            f"that the board is sharp in the all-in-focus pictures"
        )
    start, _ = _from_triangulated(model, board, seen)
    fit, sigma = _fit_to_pixels(model, board, seen, start)
    wrong = _wrong(_residuals_px(model, board, seen, fit))
    right = seen.only(~wrong)
    right = right.only(_seen_twice(right))
    if wrong.any() and len(np.unique(right.corners)) >= FEWEST_CORNERS:
        seen = right
        fit, sigma = _fit_to_pixels(model, board, seen, fit)
    start, residual_mm = _from_triangulated(model, board, seen)
    facts = {
        "corners": len(np.unique(seen.corners)),
        "detections": len(seen.corners),
        "views": len(np.unique(seen.views)),
        "residual_px": float(np.sqrt(np.mean(np.sum(_residuals_px(model, board, seen, fit) ** 2, axis=1)))),
        "residual_mm": residual_mm,
        "uncertainty_of_corners": sigma,
        "metres_per_unit_of_triangulated_corners": 1.0 / start.scale,
    }
    of_poses = POSES_SIGMA_WITH_DISTORTION if any(any(view.distortion) for view in model.views) else POSES_SIGMA
    return ScaleAnswer(
        method="board",
        metres_per_unit=1.0 / fit.scale,
        uncertainty=float(np.hypot(sigma, of_poses)),
        facts=facts,
        outlines_px=board_outlines(model, board, seen, fit),
    )


def board_outlines(model: SparseModel, board: CharucoBoard, seen: BoardDetections, fit: Similarity) -> dict[str, list[list[float]]]:
    """Return the four corners of the board in the picture of every view that saw it; they may lie beyond the frame."""
    width_m, height_m = (side / MM_PER_M for side in board.size_mm)
    corners_m = np.array([(0.0, 0.0, 0.0), (width_m, 0.0, 0.0), (width_m, height_m, 0.0), (0.0, height_m, 0.0)])
    views = [model.views[index] for index in np.unique(seen.views)]
    return {view.name: view.project(fit(corners_m))[0].tolist() for view in views}


def _wrong(residuals_px: Float[np.ndarray, "seen 2"]) -> np.ndarray:
    """Mark residuals beyond five standard deviations: a partly covered corner lies about a pixel off."""
    off_px = np.linalg.norm(residuals_px, axis=1)
    return off_px > max(_WRONG_SIGMAS * float(np.median(off_px)) / MEDIAN_OF_RAYLEIGH, _LEAST_WRONG_PX)


def _from_triangulated(model: SparseModel, board: CharucoBoard, seen: BoardDetections) -> tuple[Similarity, float]:
    """Return the similarity from the board to the triangulated corners, and their root mean square distance from it in mm."""
    corners = np.unique(seen.corners)
    points = np.array(
        [triangulate([model.views[v] for v in seen.views[seen.corners == c]], seen.xy_px[seen.corners == c]) for c in corners]
    )
    found = umeyama(board.corners_m[corners], points)
    off_m = (points - found(board.corners_m[corners])) / found.scale
    return found, float(np.sqrt(np.mean(np.sum(off_m**2, axis=1))) * MM_PER_M)


def _seen_twice(seen: BoardDetections) -> np.ndarray:
    return np.bincount(seen.corners)[seen.corners] >= 2 if len(seen.corners) else np.zeros(0, bool)


def triangulate(views: Sequence[SparseView], xy_px: Float[np.ndarray, "seen 2"]) -> Float[np.ndarray, "3"]:
    """Return the point with the least squared distance from the rays of all views."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for view, place in zip(views, xy_px, strict=True):
        pinhole = undistorted_px(view.camera, view.distortion, place)
        ray = view.camera.unproject(pinhole, np.asarray(1.0)) - view.centre
        across = np.eye(3) - np.outer(ray, ray) / (ray @ ray)
        matrix += across
        right += across @ view.centre
    return np.linalg.solve(matrix, right)


def umeyama(source: Points, target: Points) -> Similarity:
    """Return the similarity with the least squared distance from source to target (Umeyama 1991, eqs. 40-42)."""
    mean_s, mean_t = source.mean(axis=0), target.mean(axis=0)
    centred_s, centred_t = source - mean_s, target - mean_t
    u, singular, vt = np.linalg.svd(centred_t.T @ centred_s)
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    rotation = u * sign @ vt
    scale = float((singular * sign).sum() / (centred_s**2).sum())
    return Similarity(scale, rotation, mean_t - scale * rotation @ mean_s)


def _fit_to_pixels(model: SparseModel, board: CharucoBoard, seen: BoardDetections, start: Similarity) -> tuple[Similarity, float]:
    """Return (the similarity of least robust reprojection errors, the relative standard deviation of its scale)."""

    def similarity(parameters: np.ndarray) -> Similarity:
        turn = Rotation.from_rotvec(parameters[1:4]).as_matrix()
        return Similarity(start.scale * float(np.exp(parameters[0])), turn @ start.rotation, start.translation + length * parameters[4:])

    def residuals(parameters: np.ndarray) -> np.ndarray:
        return _residuals_px(model, board, seen, similarity(parameters)).ravel()

    length = start.scale * board.grids[0].square_mm / MM_PER_M
    result = least_squares(residuals, np.zeros(7), loss="soft_l1", f_scale=0.5, x_scale="jac")
    freedom = max(result.fun.size - 7, 1)
    covariance = np.linalg.inv(result.jac.T @ result.jac) * float(result.fun @ result.fun) / freedom
    return similarity(result.x), float(np.sqrt(covariance[0, 0]))


def _residuals_px(model: SparseModel, board: CharucoBoard, seen: BoardDetections, fit: Similarity) -> Float[np.ndarray, "seen 2"]:
    points = fit(board.corners_m)[seen.corners]
    residuals = np.empty((len(points), 2))
    for index in np.unique(seen.views):
        of_view = seen.views == index
        residuals[of_view] = model.views[index].project(points[of_view])[0] - seen.xy_px[of_view]
    return residuals


def board_from_options(board: str, square_mm: float | None, marker_mm: float | None, dictionary: str) -> CharucoBoard:
    """Return the board of the options: "COLUMNSxROWS" with its sizes, or the path of a board.toml or board.json."""
    if board.endswith((".toml", ".json")):
        return read_board(Path(board))
    try:
        columns, rows = (int(each) for each in board.lower().split("x"))
    except ValueError:
        raise InputError(f"--board must be COLUMNSxROWS such as 8x6, a board.toml or a board.json, got {board!r}") from None
    if square_mm is None or marker_mm is None:
        raise InputError("--board COLUMNSxROWS needs --square and --marker as measured on the print")
    return CharucoBoard((CharucoGrid((columns, rows), square_mm, marker_mm),), dictionary)


class BoardSearch:
    """A thorough search for a board's corners in photographs.

    The board is tried as printed by OpenCV before and since 4.6, since nobody knows which version made a print.
    The whole print is not fitted to the picture (mrbokeh.tracking.charuco.board_alignment). On a traced board with white paper around it
    that took the corners' error from 0.070 to 0.016 px and what they add to the scale's error from 0.02 to 0.004 %, where poses add 0.05 %;
    but its homography knows no distortion, which photographs keep here, and a board cut off at its squares does not fit.
    """

    def __init__(self, board: CharucoBoard) -> None:
        self._detectors = [CharucoDetector(replace(board, legacy=legacy)) for legacy in (board.legacy, not board.legacy)]

    def corners(self, rgb8: UInt8[np.ndarray, "height width 3"]) -> Corners:
        """Return the corners of the search that found most. Small pictures are also searched enlarged, which finds smaller markers."""
        grey = cv2.cvtColor(np.ascontiguousarray(rgb8), cv2.COLOR_RGB2GRAY)
        scales = (1, 2) if max(grey.shape) <= _ENLARGED_UP_TO_PX else (1,)
        return max((each.detect_enlarged(grey, enlarged) for enlarged in scales for each in self._detectors), key=len)
