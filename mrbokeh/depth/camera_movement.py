"""Movement of a hand-held camera between two photographs of one still scene, from what both show; its length stays unknown.

Points are found by SIFT (Lowe 2004), the movement by the five-point method (Nister 2004) with robust votes, then by least squares of
where points should be, in front of both cameras.
"""

from dataclasses import dataclass

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError

Grey = UInt8[np.ndarray, "height width"]
Points = Float[np.ndarray, "points 2"]
Rays = Float[np.ndarray, "points 3"]
Turn = Float[np.ndarray, "3 3"]
Way = Float[np.ndarray, " 3"]

LEAST_NEARNESS = 0.01
"""Least movement as a share of the distance of the nearest things: below it a disparity off by a quarter of a pixel is 3 % of depth."""
_MOST_FEATURES, _FAINTEST, _BEST_BY = 5000, 0.02, 0.8
_LEAST_POINTS, _LEAST_SHARE = 40, 0.3
_WITHIN_PX, _ROUNDS = 1.0, 2
_SHIFTS = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (1.0, 1.0, 0.0), (1.0, -1.0, 0.0), (0.0, 0.0, 1.0))
_LEAST_PARALLAX_PX = 2.0
_MOST_AHEAD = 0.4
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
    focal_px, middle_px = camera.focal_px[0], np.asarray(camera.principal_px)
    here, there = (_rays((each - middle_px) / focal_px) for each in _common_points(first, second))
    pair, good = _likeliest(here, there, _WITHIN_PX / focal_px)
    if good.sum() < max(_LEAST_POINTS, _LEAST_SHARE * len(good)):
        raise InputError(
            f"{told} have too little in common for depth, {good.sum()} of {len(good)} points: expected one still scene, "
            f"photographed twice from places a hand's breadth apart"
        )
    here, there = here[good], there[good]
    movement = Movement(pair.turn, -pair.turn.T @ pair.shift, pair.nearness(here, there))
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
    pairs = cv2.BFMatcher().knnMatch(ours, theirs, k=2)
    best = [pair[0] for pair in pairs if len(pair) == 2 and pair[0].distance < _BEST_BY * pair[1].distance]
    at = [(here[each.queryIdx].pt, there[each.trainIdx].pt) for each in best]
    points_px = np.array(at, np.float64).reshape(-1, 2, 2) + 0.5  # OpenCV counts from the centre of the first pixel
    return points_px[:, 0], points_px[:, 1]


def _rays(plane: Points) -> Rays:
    return np.concatenate([plane, np.ones_like(plane[:, :1])], axis=1)


@dataclass(frozen=True)
class _Pair:
    """Pose of the second camera: a point here lies there along turn here + nearness shift."""

    turn: Turn
    shift: Way

    def nearness(self, here: Rays, there: Rays) -> Float[np.ndarray, " points"]:
        off, along = np.cross(there, here @ self.turn.T), np.cross(there, self.shift)
        return -(off * along).sum(axis=1) / np.maximum((along**2).sum(axis=1), 1e-12)

    def apart(self, here: Rays, there: Rays) -> Points:
        """Return how far points there are from where they should be at their best depth in front of the camera, on the plane of rays."""
        expected = here @ self.turn.T + np.maximum(self.nearness(here, there), 0.0)[:, None] * self.shift
        return expected[:, :2] / np.maximum(expected[:, 2:], 1e-6) - there[:, :2]

    def explained(self, here: Rays, there: Rays, within: float) -> Bool[np.ndarray, " points"]:
        """Mark points that are where they should be."""
        return np.linalg.norm(self.apart(here, there), axis=1) < within


def _likeliest(here: Rays, there: Rays, within: float) -> tuple[_Pair, Bool[np.ndarray, " points"]]:
    """Return the pose that explains most points, and which.

    Votes count points near their lines; where a plane fills the picture, another movement brings them there as well, but sees half of
    them behind the cameras. So movements in plain directions are refined beside the elected one, by where points are in front.
    """
    best, good = _Pair(np.eye(3), np.array(_SHIFTS[0])), np.zeros(len(here), bool)
    if len(here) < _LEAST_POINTS:
        return best, good
    here_2, there_2 = (np.ascontiguousarray(each[:, :2]) for each in (here, there))
    essential, mask = cv2.findEssentialMat(here_2, there_2, np.eye(3), method=cv2.USAC_MAGSAC, prob=0.9999, threshold=within)
    if essential is None or mask is None or not mask.any():
        return best, good
    voted = mask.ravel() > 0
    _, turn, shift, _ = cv2.recoverPose(essential[:3], here_2[voted], there_2[voted], np.eye(3))
    turned = _best_turn(here[voted], there[voted])
    plain = [side * np.array(each) / np.linalg.norm(each) for each in _SHIFTS for side in (1.0, -1.0)]
    for start in (_Pair(turn, shift.ravel()), *(_Pair(turned, each) for each in plain)):
        pair, chosen = start, voted
        for _ in range(_ROUNDS):
            pair = _refined(pair, here[chosen], there[chosen], 0.5 * within)
            chosen = pair.explained(here, there, within)
            if chosen.sum() < _LEAST_POINTS:
                break
        if chosen.sum() > good.sum():
            best, good = pair, chosen
    return best, good


def _refined(start: _Pair, here: Rays, there: Rays, soft: float) -> _Pair:
    """Return the pose near a first one that brings points closest to where they should be."""
    from scipy.optimize import least_squares

    across = np.linalg.svd(start.shift[None])[2][1:]

    def moved(by: np.ndarray) -> _Pair:
        shift = start.shift + by[3:] @ across
        return _Pair(cv2.Rodrigues(by[:3])[0] @ start.turn, shift / np.linalg.norm(shift))

    def errors(by: np.ndarray) -> np.ndarray:
        return moved(by).apart(here, there).ravel()

    return moved(least_squares(errors, np.zeros(5), loss="soft_l1", f_scale=soft, x_scale="jac").x)


def _best_turn(here: Rays, there: Rays) -> Turn:
    """Return the rotation that brings rays closest to others (Kabsch 1976)."""
    left, _, right = np.linalg.svd(there.T @ here)
    return left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
