"""Movement of a hand-held camera between two photographs of one still scene, from what both show; its length stays unknown.

Points are found by SIFT (Lowe 2004), the movement by the five-point method (Nister 2004) with robust votes, then by least squares of
the points' distances from their epipolar lines.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError

Grey = UInt8[np.ndarray, "height width"]
Points = Float[np.ndarray, "points 2"]
Turn = Float[np.ndarray, "3 3"]
Way = Float[np.ndarray, " 3"]

LEAST_NEARNESS = 0.01
"""Least movement as a share of the distance of the nearest things: below it a disparity off by a quarter of a pixel is 3 % of depth."""
_MOST_FEATURES, _FAINTEST, _BEST_BY = 8000, 0.02, 0.8
_LEAST_POINTS, _LEAST_SHARE = 40, 0.3
_WITHIN_PX, _SOFT_PX = 1.0, 0.5
_LEAST_PARALLAX_PX = 2.0
_MOST_AHEAD = 0.7
_NEAREST_PERCENT = 95.0


@dataclass(frozen=True)
class Movement:
    """Movement of a camera.

    turn: (3, 3) brings directions from the axes of the first camera into those of the second. way: (3,) of length 1, from the first
    place to the second in the first's axes. nearness: of each point that both show, the length of the way over its depth.
    """

    turn: Turn
    way: Way
    nearness: Float[np.ndarray, " points"]


def camera_movement(first: Grey, second: Grey, camera: Camera, told: str) -> Movement:
    """Return how the camera moved. camera: of both, without pose. told: the two photographs, in words.

    Raises InputError where they show too little that is common, or show no parallax, or where the camera went ahead or zoomed.
    """
    here_px, there_px = _common_points(first, second)
    focal_px, middle_px = camera.focal_px[0], np.asarray(camera.principal_px)
    matrix = np.array([[focal_px, 0.0, 0.0], [0.0, focal_px, 0.0], [0.0, 0.0, 1.0]])
    here_px, there_px = here_px - middle_px, there_px - middle_px
    found = np.zeros(len(here_px), bool)
    if len(here_px) >= _LEAST_POINTS:
        essential, mask = cv2.findEssentialMat(here_px, there_px, matrix, method=cv2.USAC_MAGSAC, prob=0.9999, threshold=_WITHIN_PX)
        found = found if mask is None else mask.ravel() > 0
    if found.sum() < max(_LEAST_POINTS, _LEAST_SHARE * len(found)):
        raise InputError(
            f"{told} have too little in common for depth, {found.sum()} points of at least {_LEAST_POINTS}: expected one still scene, "
            f"photographed twice from places a hand's breadth apart"
        )
    here, there = (_rays(each[found] / focal_px) for each in (here_px, there_px))
    _, turn, shift, _ = cv2.recoverPose(essential[:3], here_px[found], there_px[found], matrix)
    movement = _refined(turn, shift.ravel(), here, there, _SOFT_PX / focal_px)
    parallax_px = focal_px * np.percentile(np.linalg.norm(here @ _best_turn(here, there).T - there, axis=1), _NEAREST_PERCENT)
    if parallax_px < _LEAST_PARALLAX_PX or np.percentile(movement.nearness, _NEAREST_PERCENT) < LEAST_NEARNESS:
        raise InputError(
            f"between {told} the camera turned or zoomed but hardly moved, which shows no depth: expected places apart by more than "
            f"{100 * LEAST_NEARNESS:g} % of the distance of the nearest things, best by a hand's breadth"
        )
    if abs(movement.way[2]) > _MOST_AHEAD:
        raise InputError(
            f"between {told} the camera moved along its view or zoomed: expected one that moved sideways or up, by a hand's breadth"
        )
    return movement


def _common_points(first: Grey, second: Grey) -> tuple[Points, Points]:
    """Return where both pictures show the same points, in pixels."""
    sift = cv2.SIFT.create(nfeatures=_MOST_FEATURES, contrastThreshold=_FAINTEST)
    (here, ours), (there, theirs) = (sift.detectAndCompute(each, None) for each in (first, second))
    if min(len(here), len(there)) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    pairs = cv2.FlannBasedMatcher().knnMatch(ours, theirs, k=2)
    best = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < _BEST_BY * pair[1].distance]
    at = [(here[each.queryIdx].pt, there[each.trainIdx].pt) for each in best]
    points_px = np.array(at, np.float64).reshape(-1, 2, 2) + 0.5  # OpenCV counts from the centre of the first pixel
    return points_px[:, 0], points_px[:, 1]


def _rays(plane: Points) -> Float[np.ndarray, "points 3"]:
    return np.concatenate([plane, np.ones_like(plane[:, :1])], axis=1)


def _refined(turn: Turn, shift: Way, here: np.ndarray, there: np.ndarray, soft: float) -> Movement:
    """Return the movement near a first one that brings points closest to their epipolar lines."""
    from scipy.optimize import least_squares

    across = np.linalg.svd(shift[None])[2][1:]

    def moved(by: np.ndarray) -> tuple[Turn, Way]:
        shifted = shift + by[3:] @ across
        return cv2.Rodrigues(by[:3])[0] @ turn, shifted / np.linalg.norm(shifted)

    def apart(by: np.ndarray) -> np.ndarray:
        turned, shifted = moved(by)
        essential = np.cross(shifted, turned, axisb=0).T
        lines, back = here @ essential.T, there @ essential
        return (there * lines).sum(axis=1) / np.sqrt((lines[:, :2] ** 2).sum(axis=1) + (back[:, :2] ** 2).sum(axis=1))

    turned, shifted = moved(least_squares(apart, np.zeros(5), loss="soft_l1", f_scale=soft, x_scale="jac").x)
    # There lies along turned here + nearness shifted.
    off, along = np.cross(there, here @ turned.T), np.cross(there, shifted)
    nearness = -(off * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-12)
    return Movement(turned, -turned.T @ shifted, nearness)


def _best_turn(here: np.ndarray, there: np.ndarray) -> Turn:
    """Return the rotation that brings rays closest to others (Kabsch 1976)."""
    left, _, right = np.linalg.svd(there.T @ here)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
