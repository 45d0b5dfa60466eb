"""Poses of the frames between two keyframes.

Points that a keyframe sees of the model are carried by optical flow, forwards from one and backwards from the other, and each
frame's pose is solved from both (PnP with RANSAC, then least squares).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from jaxtyping import Float64, Int64

from capture.poses.sparse_model import SparseModel, SparseView
from mrbokeh.distortion.radial import Distortion, undistorted_px
from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.camera_track.track import camera_between
from mrbokeh.tracking.charuco.detector import Grey, flow
from mrbokeh.tracking.charuco.pose_from_points import Pose, opencv_matrix

FEWEST_POINTS = 12
"""With fewer, wrong points agree on a pose now and then."""

_MOST_POINTS = 600
_WRONG_PX = 2.0
_ITERATIONS = 200
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-10)


@dataclass(frozen=True)
class SeenPoints:
    """Points of the model in a picture. points: indices into the model. xy_px: their positions."""

    points: Int64[np.ndarray, " seen"]
    xy_px: Float64[np.ndarray, "seen 2"]


@dataclass(frozen=True)
class FramePose:
    """The pose of one frame.

    camera: with its pose in the model's unit. residual_px: RMS over the points that fit. fitting: their fraction of those carried here.
    """

    camera: Camera
    distortion: Distortion
    residual_px: float
    fitting: float


def seen_by(model: SparseModel, view: SparseView) -> SeenPoints:
    """Return the points of a view seen by the most other views, as many as it takes to fill the picture."""
    points = model.points_of(view).astype(np.int64)
    xy_px, _ = model.depths_in(view)
    often = np.bincount(model.observations[:, 1], minlength=len(model.points))[points]
    best = np.argsort(-often, kind="stable")[:_MOST_POINTS]
    return SeenPoints(points[best], xy_px[best].astype(np.float64))


def poses_between(model: SparseModel, greys: Sequence[Grey], ends: Mapping[int, SparseView]) -> dict[int, FramePose]:
    """Return the poses of the frames between the ends on which at least 12 points agree.

    greys: consecutive frames of one stretch. ends: the views of its first and last frame, by place in greys; one may be missing.
    """
    carried: list[list[SeenPoints]] = [[] for _ in greys]
    for place, view in ends.items():
        steps = range(place + 1, len(greys)) if place == 0 else range(place - 1, -1, -1)
        seen = seen_by(model, view)
        for other in steps:
            seen = _carried(greys[other + (1 if place else -1)], greys[other], seen)
            carried[other].append(seen)
    return {place: pose for place in range(len(greys)) if place not in ends if (pose := _pose(model, carried[place], _guess(ends, place)))}


def _guess(ends: Mapping[int, SparseView], place: int) -> SparseView:
    """Interpolate between the ends as a start."""
    places = sorted(ends)
    if len(places) == 1:
        return ends[places[0]]
    share = (place - places[0]) / (places[-1] - places[0])
    one, other = ends[places[0]], ends[places[-1]]
    return replace(one, camera=camera_between(one.camera, other.camera, share))


def _carried(start: Grey, end: Grey, seen: SeenPoints) -> SeenPoints:
    there, good = flow(start, end, seen.xy_px)
    return SeenPoints(seen.points[good], there[good])


def _pose(model: SparseModel, carried: Sequence[SeenPoints], guess: SparseView) -> FramePose | None:
    points = model.points[np.concatenate([each.points for each in carried])].astype(np.float64)
    xy_px = np.concatenate([each.xy_px for each in carried])
    straight_px = undistorted_px(guess.camera, guess.distortion, xy_px)
    told = np.isfinite(straight_px).all(axis=1)
    if np.count_nonzero(told) < FEWEST_POINTS:
        return None
    found = _solved(points[told], straight_px[told], guess.camera)
    return None if found is None else FramePose(replace(guess.camera, camera_from_world=found[0]), guess.distortion, *found[1:])


def _solved(points: np.ndarray, xy_px: np.ndarray, camera: Camera) -> tuple[Pose, float, float] | None:
    """Return (camera_from_world, RMS distance of the points that fit, their fraction)."""
    matrix, before = opencv_matrix(camera), camera.camera_from_world
    wrong_px = max(1.0, _WRONG_PX * camera.width_px / 1280)
    cv2.setRNGSeed(0)
    turn, shift = cv2.Rodrigues(before[:3, :3])[0], before[:3, 3:].copy()
    fits, turn, shift, kept = cv2.solvePnPRansac(
        points, xy_px, matrix, None, turn, shift, True, _ITERATIONS, wrong_px, flags=cv2.SOLVEPNP_ITERATIVE
    )
    if not fits or kept is None or len(kept) < FEWEST_POINTS:
        return None
    inliers = np.ravel(kept)
    turn, shift = cv2.solvePnPRefineLM(points[inliers], xy_px[inliers], matrix, None, turn, shift, _STOP)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
    seen_px, depth = replace(camera, camera_from_world=pose).project(points[inliers])
    if not (depth > 0).all():
        return None
    residual_px = float(np.sqrt(np.mean(np.sum((seen_px - xy_px[inliers]) ** 2, axis=1))))
    return pose, residual_px, len(inliers) / len(points)
