"""Match-move of a clip: keyframes to COLMAP, then every frame against the model that comes back.

Keyframes are evenly spread over the motion of the picture: none while the camera rests, many in a fast pan.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64

from capture.matchmove.frame_poses import FramePose, poses_between
from capture.matchmove.ground import GroundPicks, Ruler, on_ground, ruler_scale
from capture.matchmove.quality_warnings import quality_warnings, require_translation
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
