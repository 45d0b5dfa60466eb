"""Match-move of a clip: solved once and kept, then stood in a world of its own as often as one likes.

The simplest camera that explains the features is taken: one that only turns, one before a flat scene, else a path through space by COLMAP.
Where COLMAP finds none that is better than a simple one, the simple one serves with what it leaves.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import UInt8

from capture.matchmove.clip_solve import FLAT, SPACE, TURNING, ClipSolve, begin_solving, read_solve, write_solve
from capture.matchmove.flow_tracks import FlowTracks, followed
from capture.matchmove.ground import GroundPicks, Horizon, Ruler, on_ground, on_own_plane, ruler_scale, upright
from capture.matchmove.keyframes import chosen_keyframes, frame_of, motion_of_clip, view_name, write_keyframes
from capture.matchmove.simple_cameras import Focal
from capture.matchmove.simple_solve import simple_solve
from capture.matchmove.space_solve import space_solve
from capture.poses.colmap import PoseSettings
from capture.poses.sparse_model import SparseModel, SparseView
from capture.scale.answer import distance_scale
from capture.scale.board import board_scale
from mrbokeh.system.console import track, working
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.track import CameraTrack, TrackedFrame
from mrbokeh.tracking.charuco.board import CharucoBoard
from mrbokeh.tracking.charuco.detector import Grey
from mrbokeh.video.clip import VideoInfo, probe, read_display_frames

_STILL_SHARE = 0.02
_SIMPLE_APART_SHARE = 0.012
"""Of the picture's width between keyframes of a simple camera: close together, so that moving things do not break the chain."""

_USUAL_FOCAL = 28.0 / 36.0
"""Focal length over the picture's long side where nothing tells: 28 mm on full frame, as phones have."""

_FILM_DIAGONAL_MM = 43.27
_FOCAL_KEY = "focal_length.35mm_equivalent"


@dataclass(frozen=True)
class MatchmoveSettings:
    """Settings of a match-move. keyframes: at most so many go to COLMAP. focal_length_35mm: in mm of full frame, None if nobody knows.

    Metres come from a board that is seen in the clip, a ruler on the ground, or the distance of the cameras of two frames, whichever
    is given first; of a camera that only turns from its height over the ground. ground: the place of the world.
    """

    keyframes: int = 40
    camera_model: str = "SIMPLE_RADIAL"
    mapper: str = "incremental"
    max_image_size_px: int = 1600
    focal_length_35mm: float | None = None
    board: CharucoBoard | None = None
    ground: GroundPicks | None = None
    ruler: Ruler | None = None
    distance: tuple[int, int, float] | None = None
    horizon: Horizon | None = None
    camera_height_m: float | None = None

    @property
    def picked_frames(self) -> set[int]:
        picks = {each.frame for each in (self.ground, self.ruler, self.horizon) if each is not None}
        return picks | set(() if self.distance is None else self.distance[:2])


@dataclass(frozen=True)
class Matchmove:
    """The result. track: metric only with a scale. solve: in the track's world and unit. assumed: what was guessed, in words."""

    track: CameraTrack
    solve: ClipSolve
    has_ground: bool
    assumed: tuple[str, ...] = ()


def matchmove_clip(clip: Path, work: Path, settings: MatchmoveSettings | None = None) -> Matchmove:
    """Find the camera of every frame. work: folder for keyframes, COLMAP's files and the solve, which is kept for other grounds and rulers.

    Raises InputError if the camera rests, or nothing explains the clip.
    """
    settings, info = settings or MatchmoveSettings(), probe(clip)
    poses = PoseSettings(settings.mapper, settings.camera_model, "shared", settings.max_image_size_px)  # refused before a solve is given up
    same = begin_solving(work, _key(clip, settings))
    solve = read_solve(work) if same else None
    if solve is None:
        solve = _solved(clip, info, work, settings, replace(poses, overwrite=not same))
        write_solve(work, solve)
    if settings.picked_frames and not 0 <= min(settings.picked_frames) <= max(settings.picked_frames) < len(solve.times_s):
        last = len(solve.times_s) - 1
        raise InputError(f"{clip} has frames 0 to {last}, but pixels or places were given of {sorted(settings.picked_frames)}")
    for name, picks in (("--ground", settings.ground), ("--ruler", settings.ruler)):
        if picks is not None and not ((picks.xy_px >= 0) & (picks.xy_px <= (info.width_px, info.height_px))).all():
            outside = "/".join(f"{x:g},{y:g}" for x, y in picks.xy_px)
            raise InputError(
                f"{name}: {outside} lies outside of the picture ({info.width_px}x{info.height_px} px): give pixels of the clip"
            )
    return _standing(solve, settings, work / "images")


def _key(clip: Path, settings: MatchmoveSettings) -> dict[str, object]:
    stat = clip.stat()
    names = ("keyframes", "camera_model", "mapper", "max_image_size_px", "focal_length_35mm")
    return {"clip": str(clip.resolve()), "bytes": stat.st_size, "modified_s": stat.st_mtime} | {
        name: getattr(settings, name) for name in names
    }


def _solved(clip: Path, info: VideoInfo, work: Path, settings: MatchmoveSettings, poses: PoseSettings) -> ClipSolve:
    motion = motion_of_clip(clip, info)
    if motion[-1] < _STILL_SHARE:
        raise InputError(
            f"{clip}: the picture moves by {100 * motion[-1]:.1f} % of its width in all, from which no motion of the camera follows: "
            f"take a single camera for all frames"
        )
    tracks, times_s = _tracks(clip, info, settings.max_image_size_px)
    keyframes = chosen_keyframes(motion, settings.keyframes, _SIMPLE_APART_SHARE)
    with working("turning or flat"):
        simple = simple_solve(tracks, keyframes, stated_focal(clip, info, settings.focal_length_35mm), times_s)
    if simple is not None and simple.explains:
        write_keyframes(clip, info, keyframes, work / "images", fresh=poses.overwrite)
        return simple.solve
    write_keyframes(clip, info, chosen_keyframes(motion, settings.keyframes), work / "images", fresh=poses.overwrite)
    try:
        return space_solve(clip, info, work, poses)
    except InputError as error:
        if simple is not None and simple.usable:
            return simple.solve
        raise InputError(
            f"{clip}: no match-move ({error}). Neither does a camera that turns, or one before a flat scene, explain it: film with the "
            f"camera moving sideways past things that stand still, or track a printed board with `mrbokeh track`"
        ) from None


def _tracks(clip: Path, info: VideoInfo, longest_px: int) -> tuple[FlowTracks, list[float]]:
    """Follow features in pictures no larger than they have to be; places are those in the clip's own pictures."""
    factor = min(1.0, longest_px / max(info.width_px, info.height_px))
    width_px, height_px = round(factor * info.width_px), round(factor * info.height_px)
    times_s: list[float] = []

    def greys() -> Iterator[Grey]:
        for frame in track(read_display_frames(clip, width_px, height_px), "features", info.frame_count or 0):
            times_s.append(frame.time_s)
            yield cv2.cvtColor(frame.bgr, cv2.COLOR_BGR2GRAY)

    tracks = followed(greys(), (width_px, height_px))
    return tracks.resized(info.width_px, info.height_px), times_s


def stated_focal(clip: Path, info: VideoInfo, focal_length_35mm: float | None) -> Focal:
    """Return what is known of the focal length: as the user says, as an iPhone writes it, or as phones have it."""
    told_mm = focal_length_35mm or _focal_in_file_mm(clip)
    if told_mm is not None:
        return Focal(told_mm / _FILM_DIAGONAL_MM * float(np.hypot(info.width_px, info.height_px)), 0.0 if focal_length_35mm else 0.1)
    return Focal(_USUAL_FOCAL * max(info.width_px, info.height_px))


def _focal_in_file_mm(clip: Path) -> float | None:
    """Return the focal length on full frame that QuickTime metadata state: of the whole sensor, of which video often takes less."""
    from mrbokeh.video.clip import opened

    with opened(clip) as (container, stream):
        told = [value for each in (container, stream) for key, value in each.metadata.items() if key.endswith(_FOCAL_KEY)]
    try:
        return next((float(each) for each in told if float(each) > 0.0), None)
    except ValueError:
        return None


def _standing(solve: ClipSolve, settings: MatchmoveSettings, pictures: Path) -> Matchmove:
    """Put the solve on the ground and in metres, as far as the settings allow."""
    assumed: tuple[str, ...] = ()
    if solve.kind == TURNING:
        model, assumed = upright(solve, settings.horizon, settings.ground, settings.camera_height_m)
    elif settings.horizon is not None or settings.camera_height_m is not None:
        raise InputError("--horizon and --camera-height are for cameras that only turn; this one moves: give --ground and --ruler")
    elif solve.kind == FLAT:
        model = on_own_plane(solve, settings.ground)
    elif settings.ground is not None:
        model = on_ground(solve.model, solve.model.view(view_name(settings.ground.frame)), settings.ground)
    else:
        model = solve.model
    model = _scaled(model, solve, settings, pictures)
    views = {frame_of(view.name): view for view in model.views}
    frames = {number: _tracked(views[number], solve.times_s[number]) for number in sorted(views)}
    made = CameraTrack(frames, "-y", model.metres_per_unit is not None).with_up("-z")
    return Matchmove(made, replace(solve, model=model), solve.kind != SPACE or settings.ground is not None, assumed)


def _scaled(model: SparseModel, solve: ClipSolve, settings: MatchmoveSettings, pictures: Path) -> SparseModel:
    if solve.kind == TURNING and (settings.board is not None or settings.distance is not None):
        raise InputError("a camera that only turns sees no lengths by itself: give --ruler on the ground, or --camera-height")
    if settings.board is not None:
        shown = replace(
            model,
            views=tuple(model.view(view_name(each)) for each in solve.keyframes if each in solve.fits),
            observations=np.zeros((0, 2), np.int64),
            observed_xy_px=np.zeros((0, 2)),
        )
        return model.times(board_scale(shown, settings.board, _pictures(shown, pictures)).metres_per_unit)
    if settings.ruler is not None:
        if settings.ground is None and solve.kind == SPACE:
            raise InputError("--ruler lies on the ground: say with --ground where that is, or give --distance or --board")
        return model.times(ruler_scale(model.view(view_name(settings.ruler.frame)), settings.ruler))
    if settings.distance is not None:
        one, other, metres = settings.distance
        return model.times(distance_scale(model, view_name(one), view_name(other), metres).metres_per_unit)
    return model


def _pictures(model: SparseModel, folder: Path) -> Iterator[UInt8[np.ndarray, "height width 3"]]:
    for view in model.views:
        yield cv2.cvtColor(np.asarray(cv2.imread(str(folder / f"{view.name}.png"))), cv2.COLOR_BGR2RGB)


def _tracked(view: SparseView, time_s: float) -> TrackedFrame:
    told = {name: value for name, value in zip(("k1", "k2"), view.distortion, strict=True) if value}
    return TrackedFrame(view.camera, time_s=time_s, distortion=told or None)
