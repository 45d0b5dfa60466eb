"""A path through space: COLMAP on keyframes, then every frame against its points; refused where a camera that only turns does as well.

COLMAP finds models for cameras that only turn: with a wrong focal length and distortion, turning looks a little like walking around a
point. The simple explanation is tried on COLMAP's own observations. If it fits as well, nothing tells where the camera was.

Points that a keyframe sees of the model are carried by optical flow, forwards from one keyframe and backwards from the next, and each
frame's pose is solved from both (PnP with RANSAC, then least squares).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, Int64

from capture.matchmove.clip_solve import SPACE, TURNING, ClipSolve, FrameFit
from capture.matchmove.flow_tracks import FlowTracks
from capture.matchmove.keyframes import frame_of, view_name
from capture.matchmove.simple_cameras import Focal, explained, residuals_px
from capture.poses.colmap import PoseSettings, find_picture_poses
from capture.poses.colmap_matches import median_parallax_deg
from capture.poses.sparse_model import SparseModel, SparseView
from mrbokeh.distortion.radial import Distortion, undistorted_px
from mrbokeh.optics.camera import Camera
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.track import camera_between
from mrbokeh.tracking.charuco.detector import Grey, flow
from mrbokeh.tracking.charuco.pose_from_points import Pose, opencv_matrix
from mrbokeh.video.clip import VideoInfo, read_display_frames

FEWEST_POINTS = 12
"""With fewer, wrong points agree on a pose now and then."""

_MOST_POINTS = 600
_WRONG_PX = 2.0
_ITERATIONS = 200
_STOP = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 1e-10)
_ROTATES_AS_WELL = 3.0
"""Multiple of the model's residual up to which a rotation explains the clip: 1.2 for a rotating camera, 22 for a moving one."""
_ROTATES_PX = 0.25
"""Residual below which it does in any case: features are not placed better than that."""
_TOO_FEW_POINTS, _FEW_POINTS = 30, 150
_SMALL_PARALLAX_DEG = 4.0
_FEW_INLIERS = 0.8


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


def space_solve(clip: Path, info: VideoInfo, work: Path, poses: PoseSettings) -> ClipSolve:
    """Solve a clip whose keyframes lie in WORK/images. Raises InputError if COLMAP finds no model, or the camera seems only to turn."""
    model = find_picture_poses(work / "images", work, poses)
    require_translation(clip, model)
    return _with_all_frames(clip, info, model)


def _points_of_keyframe(model: SparseModel) -> float:
    """Return the median number of points that a keyframe sees."""
    return float(np.median(np.bincount(model.observations[:, 0], minlength=len(model.views))))


def require_translation(clip: Path, model: SparseModel) -> None:
    """Raise InputError if the camera seems to have stayed at one place."""
    if (points := _points_of_keyframe(model)) < _TOO_FEW_POINTS:
        raise InputError(
            f"{clip}: COLMAP placed {len(model.views)} keyframes by {points:.0f} points each, too few to trust: film more texture with the "
            f"camera moving sideways (one that only rotates gives no points), or track a printed board"
        )
    rotating_px, model_px = rotation_only_residual_px(model), float(np.median(off_px(model)))
    if rotating_px < max(_ROTATES_AS_WELL * model_px, _ROTATES_PX):
        raise InputError(
            f"{clip}: the camera seems only to rotate (rotation alone explains the clip to {rotating_px:.2f} px, a path through space to "
            f"{model_px:.2f} px), so that nothing tells where it was: film with the camera moving sideways, or track a printed board"
        )


def quality_warnings(model: SparseModel, found: list[FramePose], parallax_deg: float) -> tuple[str, ...]:
    """Return warnings about a scene that moves, or a camera that hardly does."""
    points = _points_of_keyframe(model)
    fitting = float(np.median([pose.fitting for pose in found])) if found else 1.0
    left_out = len(model.left_out)
    told = (
        (points < _FEW_POINTS, f"a keyframe sees only {points:.0f} points of the model"),
        (parallax_deg < _SMALL_PARALLAX_DEG, f"points are seen under {parallax_deg:.1f} degrees only, so that depth is uncertain"),
        (fitting < _FEW_INLIERS, f"of the points carried into a frame only {100 * fitting:.0f} % move with the scene"),
        (left_out > 0, f"{left_out} of {left_out + len(model.views)} keyframes could not be placed"),
    )
    return tuple(text for doubtful, text in told if doubtful)


def rotation_only_residual_px(model: SparseModel) -> float:
    """Return the median reprojection error of a camera that only rotates."""
    camera = model.views[0].camera
    views, points = model.observations.T.astype(np.int64)
    size_px = (camera.width_px, camera.height_px)
    tracks = FlowTracks(
        frames=views, features=points, xy_px=model.observed_xy_px.astype(np.float64), size_px=size_px, frame_count=len(model.views)
    )
    found = explained(tracks, TURNING, Focal(camera.focal_px[0]))
    return np.inf if found is None else float(np.median(residuals_px(*found)))


def off_px(model: SparseModel) -> np.ndarray:
    """Return the reprojection error of each observation."""
    off = np.zeros(len(model.observations))
    for index, view in enumerate(model.views):
        seen = model.observations[:, 0] == index
        off[seen] = np.linalg.norm(view.project(model.points[model.observations[seen, 1]])[0] - model.observed_xy_px[seen], axis=1)
    return off


def _with_all_frames(clip: Path, info: VideoInfo, model: SparseModel) -> ClipSolve:
    views = {frame_of(view.name): view for view in model.views}
    found: dict[int, FramePose] = {}
    times_s: list[float] = []
    stretch: list[Grey] = []
    first = 0
    for number, frame in enumerate(track(read_display_frames(clip, info.width_px, info.height_px), "frames", info.frame_count or 0)):
        times_s.append(frame.time_s)
        stretch.append(cv2.cvtColor(frame.bgr, cv2.COLOR_BGR2GRAY))
        if number in views:
            found |= _stretch(model, stretch, first, views)
            first, stretch = number, stretch[-1:]
    found |= _stretch(model, stretch, first, views)
    each_px = off_px(model)
    fits = {n: FrameFit(float(np.median(each_px[model.observations[:, 0] == index])), 1.0) for index, n in enumerate(views)}
    fits |= {n: FrameFit(pose.residual_px, pose.fitting) for n, pose in found.items()}
    parallax_deg = median_parallax_deg(model)
    return ClipSolve(
        kind=SPACE,
        model=_of_all(model, found),
        times_s=tuple(times_s),
        keyframes=tuple(views),
        fits=fits,
        why=f"a path through space, by COLMAP from {len(views)} keyframes",
        parallax_deg=parallax_deg,
        warnings=quality_warnings(model, list(found.values()), parallax_deg),
    )


def _of_all(model: SparseModel, found: Mapping[int, FramePose]) -> SparseModel:
    """Return the model with a view for every frame; only keyframes have observations, and come first."""
    others = tuple(SparseView(view_name(number), pose.camera, pose.distortion) for number, pose in sorted(found.items()))
    return replace(model, views=(*model.views, *others))


def _stretch(model: SparseModel, greys: list[Grey], first: int, views: Mapping[int, SparseView]) -> dict[int, FramePose]:
    """Find the poses of the frames from `first` on between keyframes; its ends are keyframes if they are in views."""
    last = len(greys) - 1
    ends = {place: views[first + place] for place in {0, last} if first + place in views}
    if last < 1 or not ends:
        return {}
    return {first + place: pose for place, pose in poses_between(model, greys, ends).items()}
