"""Points that posed pictures have in common, and what they tell before any sweep: ranges of depth, and which views see one another.

Cameras are known, so that features need only agree with the epipolar line; two rays then give the point.
"""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import Bool, Float, Float64, Int
from scipy.spatial import cKDTree

from mrbokeh.depth.views.sweep_view import BRIGHTEST, SweepView, neighbour_vote
from mrbokeh.optics.camera import Camera

Points = Float64[np.ndarray, "points 3"]

_FEATURES = 3000
_PARTNERS = (0, 1, 3, 6, 10)
"""Ranks of the views with which each is matched, by nearness: near ones match well, far ones have parallax."""
_LARGEST_TURN_RAD = np.deg2rad(60.0)
_RATIO = 0.8
_OFF_PX = 1.0
_LEAST_ANGLE_RAD = np.deg2rad(1.0)
_PAIRS_TO_AGREE = 3
_BESIDE, _LOOKED_AT = 0.02, 6
"""Share of the distance to the nearest camera within which two points are one; how many neighbours of a point are looked at."""
_OUTERMOST, _FARTHEST = 0.5, 1e-3
_MARGIN = 0.1
_FEWEST_IN_VIEW = 12


def common_points(views: Sequence[SweepView]) -> Points:
    """Return world points that at least two views see, and of three pairs of views or more two pairs; views: pinholes, of any sharpness."""
    sift = cv2.SIFT.create(_FEATURES)
    features = [sift.detectAndCompute(_grey(view), None) for view in views]
    cameras = [view.camera for view in views]
    found = [_triangulated(views[one], views[other], *_matched(features[one], features[other])) for one, other in _pairs(cameras)]
    points = np.concatenate([np.zeros((0, 3)), *found])
    if len(found) < _PAIRS_TO_AGREE:
        return points
    pair = np.repeat(np.arange(len(found)), [len(each) for each in found])
    return points[_repeated(points, pair, cameras)]


def _repeated(points: Points, pair: Int[np.ndarray, " points"], cameras: Sequence[Camera]) -> Bool[np.ndarray, " points"]:
    """Mark points beside which another pair of views has found one too: false matches lie anywhere along their rays."""
    if not len(points):
        return np.zeros(0, bool)
    centres = np.stack([camera.world_from_camera[:3, 3] for camera in cameras])
    reach = _BESIDE * cKDTree(centres).query(points)[0]
    apart, which = cKDTree(points).query(points, k=min(_LOOKED_AT, len(points)))
    return ((apart <= reach[:, None]) & (pair[which] != pair[:, None])).any(axis=1)


def _grey(view: SweepView) -> np.ndarray:
    return np.clip(view.structure * (255.0 / np.sqrt(BRIGHTEST)), 0, 255).astype(np.uint8)


def _pairs(cameras: Sequence[Camera]) -> list[tuple[int, int]]:
    """Return pairs of views that look about the same way, near and farther ones."""
    poses = np.stack([camera.world_from_camera for camera in cameras])
    apart = np.linalg.norm(poses[:, None, :3, 3] - poses[None, :, :3, 3], axis=2)
    turned = np.arccos(np.clip(poses[:, :3, 2] @ poses[:, :3, 2].T, -1.0, 1.0))
    pairs = set()
    for one in range(len(cameras)):
        order = [other for other in np.argsort(apart[one]) if other != one and turned[one, other] < _LARGEST_TURN_RAD]
        pairs |= {(min(one, int(order[rank])), max(one, int(order[rank]))) for rank in _PARTNERS if rank < len(order)}
    return sorted(pairs)


def _matched(one: tuple, other: tuple) -> tuple[Float64[np.ndarray, "matches 2"], Float64[np.ndarray, "matches 2"]]:
    """Return positions in pixels of features that are like each other and like no second one (Lowe 2004)."""
    (points, told), (other_points, other_told) = one, other
    if told is None or other_told is None or min(len(told), len(other_told)) < 2:
        return np.zeros((0, 2)), np.zeros((0, 2))
    matches = cv2.BFMatcher(cv2.NORM_L2).knnMatch(told, other_told, k=2)
    good = [best for best, second in matches if best.distance < _RATIO * second.distance]
    places = [(points[m.queryIdx].pt, other_points[m.trainIdx].pt) for m in good]
    both = np.array(places, np.float64).reshape(-1, 2, 2) + 0.5
    return both[:, 0], both[:, 1]


def _triangulated(
    one: SweepView, other: SweepView, one_px: Float64[np.ndarray, "matches 2"], other_px: Float64[np.ndarray, "matches 2"]
) -> Points:
    """Return the points in which two rays meet, in front of both cameras and with parallax."""
    if not len(one_px):
        return np.zeros((0, 3))
    homogeneous = cv2.triangulatePoints(_projection(one.camera), _projection(other.camera), one_px.T, other_px.T).T
    with np.errstate(divide="ignore", invalid="ignore"):
        points = homogeneous[:, :3] / homogeneous[:, 3:]
        good = np.isfinite(points).all(axis=1)
        for camera, xy_px in ((one.camera, one_px), (other.camera, other_px)):
            there_px, depth = camera.project(points)
            good &= (depth > 0) & (np.linalg.norm(there_px - xy_px, axis=1) < _OFF_PX)
    points = points[good]
    first, second = (points - view.camera.world_from_camera[:3, 3] for view in (one, other))
    cosine = (first * second).sum(axis=1) / np.maximum(np.linalg.norm(first, axis=1) * np.linalg.norm(second, axis=1), 1e-12)
    return points[np.arccos(np.clip(cosine, -1.0, 1.0)) > _LEAST_ANGLE_RAD]


def _projection(camera: Camera) -> Float64[np.ndarray, "3 4"]:
    (fx, fy), (cx, cy) = camera.focal_px, camera.principal_px
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]) @ camera.camera_from_world[:3]


def in_view(camera: Camera, points: Points) -> tuple[Bool[np.ndarray, " points"], Float[np.ndarray, " points"]]:
    """Return (which points lie in the picture, their depth along the axis); what hides what is not asked."""
    with np.errstate(divide="ignore", invalid="ignore"):
        xy_px, depth = camera.project(points)
    return (depth > 0) & (xy_px >= 0).all(axis=1) & (xy_px <= (camera.width_px, camera.height_px)).all(axis=1), depth


def dioptre_range(camera: Camera, points: Points) -> tuple[float, float] | None:
    """Return (farthest, nearest) in 1 / depth of a picture, a little beyond its nearest points; None if it shows too few.

    It goes on almost to infinity, for points so far away show no parallax, and none is among them.
    """
    inside, depth = in_view(camera, points)
    if np.count_nonzero(inside) < _FEWEST_IN_VIEW:
        return None
    nearest = (1.0 + _MARGIN) * float(np.percentile(1.0 / depth[inside], 100.0 - _OUTERMOST))
    return _FARTHEST * nearest, nearest


def best_neighbours(index: int, cameras: Sequence[Camera], points: Points, most: int) -> list[int]:
    """Return at most so many views that tell most about the depth of one, best first."""
    mine, _ = in_view(cameras[index], points)
    centres = [camera.world_from_camera[:3, 3] for camera in cameras]
    votes = np.array(
        [
            0.0 if other == index else neighbour_vote(points[mine & in_view(camera, points)[0]], centres[index], centres[other])
            for other, camera in enumerate(cameras)
        ]
    )
    return [int(each) for each in np.argsort(-votes, kind="stable")[:most] if votes[each] > 0.0]
