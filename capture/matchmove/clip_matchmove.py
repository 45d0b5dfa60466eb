"""Match-move of a clip: keyframes to COLMAP, then every frame against the model that comes back.

Keyframes are evenly spread over the motion of the picture: none while the camera rests, many in a fast pan.

A camera that only rotates is refused. COLMAP finds models for such cameras: with a wrong focal length and distortion, rotating looks a
little like walking around a point. The simple explanation is tried too: all points at infinity, one rotation for each view, one focal
length and one term of distortion, by least squares on the pixels. If it fits as well, nothing tells where the camera was.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64, Int64
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from capture.matchmove.frame_poses import FramePose, poses_between
from capture.matchmove.ground import GroundPicks, Ruler, on_ground, ruler_scale
from capture.poses.colmap import PoseSettings, find_picture_poses
from capture.poses.colmap_matches import median_parallax_deg
from capture.poses.sparse_model import SparseModel, SparseView
from capture.scale.answer import distance_scale
from capture.scale.board import board_scale
from mrbokeh.optics.camera import Camera
from mrbokeh.system.console import track
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackedFrame
from mrbokeh.tracking.charuco.board import CharucoBoard
from mrbokeh.tracking.charuco.detector import Grey, flow
from mrbokeh.video.clip import VideoInfo, probe, read_display_frames

_MOST_POINTS = 300
_FOCAL_STARTS = (0.7, 1.0, 1.4)
"""Starting focal lengths over the model's, which is wrong if the camera only rotates."""
_ROTATES_AS_WELL = 3.0
"""Multiple of the model's residual up to which a rotation explains the clip: 1.2 for a rotating camera, 22 for a moving one."""
_ROTATES_PX = 0.25
"""Residual below which it does in any case: features are not placed better than that."""
_TOO_FEW_POINTS, _FEW_POINTS = 30, 150
_SMALL_PARALLAX_DEG = 4.0
_FEW_INLIERS = 0.8


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
    rotating_px, model_px = rotation_only_residual_px(model), model_residual_px(model)
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


@dataclass(frozen=True)
class _Tracks:
    """Tracks of points. views, points: which view sees which point; offsets_px: position from the principal point."""

    views: Int64[np.ndarray, " seen"]
    points: Int64[np.ndarray, " seen"]
    offsets_px: Float64[np.ndarray, "seen 2"]
    view_count: int
    point_count: int


def rotation_only_residual_px(model: SparseModel) -> float:
    """Return the median reprojection error of a camera that only rotates."""
    tracks = _best_tracks(model)
    focal_px = model.views[0].camera.focal_px[0]
    fits = [_fitted(tracks, focal_px * factor) for factor in _FOCAL_STARTS]
    return min(float(np.median(np.linalg.norm(each.reshape(-1, 2), axis=1))) for each in fits)


def model_residual_px(model: SparseModel) -> float:
    """Return the median reprojection error of the model."""
    off = []
    for index, view in enumerate(model.views):
        seen = model.observations[:, 0] == index
        off.append(np.linalg.norm(view.project(model.points[model.observations[seen, 1]])[0] - model.observed_xy_px[seen], axis=1))
    return float(np.median(np.concatenate(off)))


def _best_tracks(model: SparseModel) -> _Tracks:
    """Return the points that most views see."""
    often = np.bincount(model.observations[:, 1], minlength=len(model.points))
    chosen = np.argsort(-often, kind="stable")[:_MOST_POINTS]
    kept = np.isin(model.observations[:, 1], chosen)
    views, points = model.observations[kept].T
    principal_px = np.array([view.camera.principal_px for view in model.views])
    _, numbered = np.unique(points, return_inverse=True)
    offsets_px = model.observed_xy_px[kept] - principal_px[views]
    return _Tracks(
        views=views.astype(np.int64),
        points=numbered.astype(np.int64),
        offsets_px=offsets_px,
        view_count=len(model.views),
        point_count=int(numbered.max()) + 1,
    )


def _fitted(tracks: _Tracks, focal_px: float) -> np.ndarray:
    """Fit the rotations and return the residuals, in pixels."""
    start = np.concatenate([[np.log(focal_px), 0.0], _chained(tracks, focal_px).as_rotvec()[1:].ravel()])
    bounds = np.full(len(start), np.inf)
    bounds[:2] = np.log(4.0), 1.0
    low, high = -bounds, bounds.copy()
    low[0], high[0] = np.log(focal_px) - bounds[0], np.log(focal_px) + bounds[0]
    solved = least_squares(_residuals, start, bounds=(low, high), loss="soft_l1", max_nfev=30, args=(tracks,))
    return _residuals(solved.x, tracks)


def _residuals(parameters: np.ndarray, tracks: _Tracks) -> np.ndarray:
    """Return the residuals in pixels; the direction of each point is the mean of the rays that see it."""
    focal_px, k1 = float(np.exp(parameters[0])), float(parameters[1])
    turns = Rotation.from_rotvec(np.concatenate([np.zeros(3), parameters[2:]]).reshape(-1, 3))[tracks.views]
    rays = turns.inv().apply(_rays(tracks.offsets_px / focal_px, k1))
    sums = np.stack([np.bincount(tracks.points, rays[:, axis], tracks.point_count) for axis in range(3)], axis=1)
    directions = turns.apply((sums / np.linalg.norm(sums, axis=1, keepdims=True))[tracks.points])
    plane = directions[:, :2] / np.maximum(directions[:, 2:], 0.05)
    bent = plane * (1.0 + k1 * np.sum(plane**2, axis=1, keepdims=True))
    return np.asarray((bent * focal_px - tracks.offsets_px).ravel())


def _rays(bent: Float64[np.ndarray, "seen 2"], k1: float) -> Float64[np.ndarray, "seen 3"]:
    """Return rays of length 1; distortion is removed by fixed-point iteration."""
    plane = bent
    for _ in range(8):
        plane = bent / np.maximum(1.0 + k1 * np.sum(plane**2, axis=1, keepdims=True), 0.2)
    rays = np.column_stack([plane, np.ones(len(plane))])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def _chained(tracks: _Tracks, focal_px: float) -> Rotation:
    """Return camera from world of each view, chained from view to view by their common points (Kabsch 1976)."""
    rays = _rays(tracks.offsets_px / focal_px, 0.0)
    turns = [Rotation.identity()]
    for one, other in pairwise(range(tracks.view_count)):
        in_one, in_other = (np.flatnonzero(tracks.views == view) for view in (one, other))
        _, first, second = np.intersect1d(tracks.points[in_one], tracks.points[in_other], return_indices=True)
        step = Rotation.identity()
        if len(first) >= 3:
            step = Rotation.align_vectors(rays[in_other[second]], rays[in_one[first]])[0]
        turns.append(step * turns[-1])
    return Rotation.concatenate(turns)


_SEARCH_WIDTH_PX = 480
_FEATURES = 200
_APART_SHARE = 0.035
"""Of the picture's width, by which neighbouring keyframes differ where there may be keyframes enough."""

_FEWEST = 8
_LOST_SHARE = 0.1
"""Motion counted for a step in which no feature could be followed: a fast blur."""
_STILL_SHARE = 0.02


@dataclass(frozen=True)
class MatchmoveSettings:
    """Settings of a match-move. keyframes: at most so many, plus those of the picks. overwrite: restart COLMAP from nothing.

    Metres come from a board that is seen in the clip, a ruler on the ground, or the distance of the cameras of two frames, whichever
    is given first. ground: the place of the world; without it as COLMAP has it.
    """

    keyframes: int = 40
    camera_model: str = "SIMPLE_RADIAL"
    mapper: str = "incremental"
    max_image_size_px: int = 1600
    board: CharucoBoard | None = None
    overwrite: bool = False
    ground: GroundPicks | None = None
    ruler: Ruler | None = None
    distance: tuple[int, int, float] | None = None

    def __post_init__(self) -> None:
        if self.ruler is not None and self.ground is None:
            raise InputError("--ruler lies on the ground: say with --ground where that is, or give --distance or --board")

    @property
    def picked_frames(self) -> set[int]:
        """Return the frames that must be keyframes."""
        picks = {each.frame for each in (self.ground, self.ruler) if each is not None}
        return picks | set(() if self.distance is None else self.distance[:2])


@dataclass(frozen=True)
class Matchmove:
    """The result. track: metric only with a scale. model: of the keyframes, in the track's unit. lost: frames without a pose.

    warnings: reasons why the track may be wrong, in words.
    """

    track: CameraTrack
    model: SparseModel
    frame_count: int
    lost: tuple[int, ...]
    residual_px: float
    parallax_deg: float
    warnings: tuple[str, ...] = ()


def matchmove_clip(clip: Path, work: Path, settings: MatchmoveSettings | None = None) -> Matchmove:
    """Find the camera of every frame. work: folder for keyframes and COLMAP's files, with which an interrupted run continues.

    Raises InputError if the camera rests or only rotates: then no position in space follows from the clip.
    """
    settings, info = settings or MatchmoveSettings(), probe(clip)
    motion = motion_of_clip(clip, info)
    if motion[-1] < _STILL_SHARE:
        raise InputError(
            f"{clip}: the picture moves by {100 * motion[-1]:.1f} % of its width in all, from which no motion of the camera follows: "
            f"take a single camera for all frames"
        )
    if settings.picked_frames and not 0 <= min(settings.picked_frames) <= max(settings.picked_frames) < len(motion):
        raise InputError(f"{clip} has frames 0 to {len(motion) - 1}, but pixels or places were given of {sorted(settings.picked_frames)}")
    keyframes = sorted({*chosen_keyframes(motion, settings.keyframes), *settings.picked_frames})
    write_keyframes(clip, info, keyframes, work / "images")
    poses = PoseSettings(settings.mapper, settings.camera_model, "shared", settings.max_image_size_px, overwrite=settings.overwrite)
    model = _of_clip(clip, work, poses)
    require_translation(clip, model)
    return _with_all_frames(clip, info, _standing(model, settings, work / "images"))


def _standing(model: SparseModel, settings: MatchmoveSettings, pictures: Path) -> SparseModel:
    """Put the model on the ground and in metres, as far as the settings allow."""
    if settings.ground is not None:
        model = on_ground(model, model.view(view_name(settings.ground.frame)), settings.ground)
    if settings.board is not None:
        return model.times(board_scale(model, settings.board, _pictures(model, pictures)).metres_per_unit)
    if settings.ruler is not None:
        return model.times(ruler_scale(model.view(view_name(settings.ruler.frame)), settings.ruler))
    if settings.distance is not None:
        one, other, metres = settings.distance
        return model.times(distance_scale(model, view_name(one), view_name(other), metres).metres_per_unit)
    return model


def _of_clip(clip: Path, work: Path, poses: PoseSettings) -> SparseModel:
    try:
        return find_picture_poses(work / "images", work, poses)
    except InputError as error:
        raise InputError(
            f"{clip}: no match-move ({error}). A camera that only rotates, and water, leaves or crowds in motion, give none: "
            f"track a printed board with `mrbokeh track`, or film with the camera moving sideways"
        ) from None


def _pictures(model: SparseModel, folder: Path) -> Iterator[np.ndarray]:
    for view in model.views:
        yield cv2.cvtColor(np.asarray(cv2.imread(str(folder / f"{view.name}.png"))), cv2.COLOR_BGR2RGB)


def _with_all_frames(clip: Path, info: VideoInfo, model: SparseModel) -> Matchmove:
    views = {int(view.name.rpartition("_")[2]): view for view in model.views}
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
    frames = {n: _tracked(view.camera, view.distortion, times_s[n]) for n, view in views.items()}
    frames |= {n: _tracked(pose.camera, pose.distortion, times_s[n]) for n, pose in found.items()}
    lost = tuple(number for number in range(len(times_s)) if number not in frames)
    residuals = [pose.residual_px for pose in found.values()] or [float(model.errors_px.mean())]
    made = CameraTrack(frames, "-y", model.metres_per_unit is not None)
    parallax_deg, residual_px = median_parallax_deg(model), float(np.sqrt(np.mean(np.square(residuals))))
    return Matchmove(
        track=made,
        model=model,
        frame_count=len(times_s),
        lost=lost,
        residual_px=residual_px,
        parallax_deg=parallax_deg,
        warnings=quality_warnings(model, list(found.values()), parallax_deg),
    )


def _stretch(model: SparseModel, greys: list[Grey], first: int, views: Mapping[int, SparseView]) -> dict[int, FramePose]:
    """Find the poses of the frames from `first` on between keyframes; its ends are keyframes if they are in views."""
    last = len(greys) - 1
    ends = {place: views[first + place] for place in {0, last} if first + place in views}
    if last < 1 or not ends:
        return {}
    return {first + place: pose for place, pose in poses_between(model, greys, ends).items()}


def _tracked(camera: Camera, distortion: tuple[float, float], time_s: float) -> TrackedFrame:
    k1, k2 = distortion
    told = {name: value for name, value in (("k1", k1), ("k2", k2)) if value}
    return TrackedFrame(camera, time_s=time_s, distortion=told or None)


def motion_of_clip(clip: Path, info: VideoInfo) -> Float64[np.ndarray, " frames"]:
    """Return how far the picture has moved by each frame: the sum of median displacements since the first, in picture widths."""
    width_px = min(_SEARCH_WIDTH_PX, info.width_px)
    height_px = max(16, round(info.height_px * width_px / info.width_px))
    moved: list[float] = []
    before: Grey | None = None
    for frame in track(read_display_frames(clip, width_px, height_px), "motion", info.frame_count or 0):
        grey = cv2.cvtColor(frame.bgr, cv2.COLOR_BGR2GRAY)
        moved.append(0.0 if before is None else _step(before, grey) / width_px)
        before = grey
    return np.cumsum(np.array(moved, np.float64))


def chosen_keyframes(motion: Float64[np.ndarray, " frames"], most: int) -> list[int]:
    """Choose frame numbers; the first and the last are always among them."""
    count = int(np.clip(motion[-1] / _APART_SHARE + 1, _FEWEST, most))
    if count >= len(motion):
        return list(range(len(motion)))
    # A little of plain time keeps places apart where nothing moves.
    along = motion + 1e-3 * np.arange(len(motion)) / len(motion)
    wanted = np.linspace(along[0], along[-1], count)
    return sorted({int(each) for each in np.abs(along[:, None] - wanted).argmin(axis=0)} | {0, len(motion) - 1})


def write_keyframes(clip: Path, info: VideoInfo, numbers: Sequence[int], folder: Path) -> None:
    """Write frame_000012.png, with the video's code values at its full size; existing ones are kept."""
    folder.mkdir(parents=True, exist_ok=True)
    wanted = {number: folder / f"{view_name(number)}.png" for number in numbers}
    for stale in set(folder.glob("frame_*.png")) - set(wanted.values()):
        stale.unlink()
    if all(path.exists() for path in wanted.values()):
        return
    for number, frame in enumerate(track(read_display_frames(clip, info.width_px, info.height_px), "keyframes", info.frame_count or 0)):
        if number in wanted:
            cv2.imwrite(str(wanted[number]), frame.bgr)


def view_name(number: int) -> str:
    return f"frame_{number:06d}"


def _step(before: Grey, grey: Grey) -> float:
    """Return the median displacement in pixels."""
    places = cv2.goodFeaturesToTrack(before, _FEATURES, 0.01, 8.0)
    if places is None:
        return 0.0
    start = places.reshape(-1, 2).astype(np.float64) + 0.5
    there, good = flow(before, grey, start)
    if np.count_nonzero(good) < 0.1 * len(start):
        return _LOST_SHARE * grey.shape[1]
    return float(np.median(np.linalg.norm(there[good] - start[good], axis=1)))
