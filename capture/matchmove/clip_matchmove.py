"""Match-move of a clip: keyframes to COLMAP, then every frame against the model that comes back."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from capture.matchmove.frame_poses import FramePose, poses_between
from capture.matchmove.keyframes import chosen_keyframes, motion_of_clip, write_keyframes
from capture.matchmove.only_turning import model_residual_px, turning_residual_px
from capture.views.colmap import PoseSettings, find_picture_poses
from capture.views.colmap_matches import median_parallax_deg
from capture.views.scale_board import board_scale
from capture.views.sparse_model import SparseModel, SparseView
from mrbokeh.camera import Camera
from mrbokeh.camera_track.track import CameraTrack
from mrbokeh.camera_track.tracked_frame import TrackedFrame
from mrbokeh.charuco.board import CharucoBoard
from mrbokeh.charuco.detector import Grey
from mrbokeh.errors import InputError
from mrbokeh.progress import track as with_progress
from mrbokeh.video_io import VideoInfo, probe, read_display_frames

_STILL_SHARE = 0.02
_TURNS_AS_WELL = 3.0
"""Times the model's residual up to which a camera that only turns explains the clip: 1.2 for one that does, 22 for one that walks."""

_TURNS_PX = 0.25
"""Below which it does in any case: features are not placed better than that."""

_TOO_FEW_POINTS, _FEW_POINTS = 30, 150
_SMALL_PARALLAX_DEG = 4.0
_FEW_INLIERS = 0.8


@dataclass(frozen=True)
class MatchmoveSettings:
    """keyframes: at most so many. board: seen in the clip, gives metres. overwrite: start COLMAP from nothing."""

    keyframes: int = 40
    camera_model: str = "SIMPLE_RADIAL"
    mapper: str = "incremental"
    max_image_size_px: int = 1600
    board: CharucoBoard | None = None
    overwrite: bool = False


@dataclass(frozen=True)
class Matchmove:
    """track: metric only with a board. model: of the keyframes, in the track's unit. lost: frames that no pose was found for.

    doubts: in words, why the track may be wrong; none where nothing speaks against it.
    """

    track: CameraTrack
    model: SparseModel
    frame_count: int
    lost: tuple[int, ...]
    residual_px: float
    parallax_deg: float
    doubts: tuple[str, ...] = ()


def matchmove_clip(clip: Path, work: Path, settings: MatchmoveSettings | None = None) -> Matchmove:
    """work: folder for keyframes and COLMAP's files, with which an interrupted run goes on.

    Raises InputError where the camera rests or only turns: then no place in space follows from the clip.
    """
    settings, info = settings or MatchmoveSettings(), probe(clip)
    motion = motion_of_clip(clip, info)
    if motion[-1] < _STILL_SHARE:
        raise InputError(
            f"{clip}: the picture moves by {100 * motion[-1]:.1f} % of its width in all, from which no motion of the camera follows: "
            f"take a single camera for all frames"
        )
    write_keyframes(clip, info, chosen_keyframes(motion, settings.keyframes), work / "images")
    poses = PoseSettings(settings.mapper, settings.camera_model, "shared", settings.max_image_size_px, overwrite=settings.overwrite)
    model = _of_clip(clip, work, poses)
    _require_walking(clip, model)
    if settings.board is not None:
        model = model.times(board_scale(model, settings.board, _pictures(model, work / "images")).metres_per_unit)
    return _with_all_frames(clip, info, model)


def _of_clip(clip: Path, work: Path, poses: PoseSettings) -> SparseModel:
    try:
        return find_picture_poses(work / "images", work, poses)
    except InputError as error:
        raise InputError(
            f"{clip}: no match-move ({error}). A camera that only turns, and water, leaves and crowds that move by themselves, give none: "
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
    for number, frame in enumerate(
        with_progress(read_display_frames(clip, info.width_px, info.height_px), "frames", info.frame_count or 0)
    ):
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
    return Matchmove(made, model, len(times_s), lost, residual_px, parallax_deg, _doubts(model, list(found.values()), parallax_deg))


def _points_of_keyframe(model: SparseModel) -> float:
    """Median number that one sees."""
    return float(np.median(np.bincount(model.observations[:, 0], minlength=len(model.views))))


def _require_walking(clip: Path, model: SparseModel) -> None:
    if (points := _points_of_keyframe(model)) < _TOO_FEW_POINTS:
        raise InputError(
            f"{clip}: COLMAP placed {len(model.views)} keyframes by {points:.0f} points each, too few to trust: film more texture with the "
            f"camera moving sideways (one that only turns gives no points), or track a printed board"
        )
    turning_px, model_px = turning_residual_px(model), model_residual_px(model)
    if turning_px < max(_TURNS_AS_WELL * model_px, _TURNS_PX):
        raise InputError(
            f"{clip}: the camera seems only to turn (turning alone explains what it sees to {turning_px:.2f} px, a way through space to "
            f"{model_px:.2f} px), so that nothing tells where it was: film with the camera moving sideways, or track a printed board"
        )


def _doubts(model: SparseModel, found: list[FramePose], parallax_deg: float) -> tuple[str, ...]:
    """What a scene at rest and a moving camera do not show."""
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


def _stretch(model: SparseModel, greys: list[Grey], first: int, views: Mapping[int, SparseView]) -> dict[int, FramePose]:
    """Frames from `first` on; its ends are keyframes where they are in views."""
    last = len(greys) - 1
    ends = {place: views[first + place] for place in {0, last} if first + place in views}
    if last < 1 or not ends:
        return {}
    return {first + place: pose for place, pose in poses_between(model, greys, ends).items()}


def _tracked(camera: Camera, distortion: tuple[float, float], time_s: float) -> TrackedFrame:
    k1, k2 = distortion
    told = {name: value for name, value in (("k1", k1), ("k2", k2)) if value}
    return TrackedFrame(camera, time_s=time_s, distortion=told or None)
