"""The camera track of a clip in which a printed board is seen."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

from mrbokeh.optics.camera import Camera
from mrbokeh.system.console import track as with_progress
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.board_calibration import Calibration, calibrated
from mrbokeh.tracking.camera_track.board_corners import RollingCorners, Undistorting, read_greys
from mrbokeh.tracking.camera_track.board_smoothing import Observation, residual_px, steadied
from mrbokeh.tracking.camera_track.clip_intrinsics import Intrinsics, intrinsics_of_clip
from mrbokeh.tracking.camera_track.track import CameraTrack
from mrbokeh.tracking.camera_track.tracked_frame import Distortion, TrackedFrame
from mrbokeh.tracking.charuco.board import CharucoBoard
from mrbokeh.tracking.charuco.detector import CharucoDetector, Corners, Grey
from mrbokeh.tracking.charuco.pose_branches import PoseFit, fits_of_shot
from mrbokeh.tracking.charuco.pose_from_points import poses_from_plane
from mrbokeh.video.clip import probe

_CALIBRATED_FROM = 240
"""Frames at most in which the board is read for calibration."""


@dataclass(frozen=True)
class TrackSettings:
    """longest_gap: so many frames without the board in sight are bridged.

    smooth: as far as the corners' own scatter leaves poses open, see `board_smoothing`. extra_px: further, so that the picture of the
      board may move by so much (RMS); it takes the trembling of a hand away, which is in the plate.
    """

    longest_gap: int = 10
    smooth: bool = True
    extra_px: float = 0.0


@dataclass(frozen=True)
class BoardTrack:
    """frame_count: of the clip. seen: frames in which the pose was measured; bridged: interpolated; lost: in neither, and not in the track.

    unsure: frames in which the board was found, but so small or so much head on that two poses fit alike; each is bridged or lost, too.
    residual_px: RMS distance of all corners from where the track's poses put them; measured_residual_px: with the poses as measured.
    """

    track: CameraTrack
    frame_count: int
    seen: int
    bridged: tuple[int, ...]
    lost: tuple[int, ...]
    residual_px: float
    measured_residual_px: float
    unsure: tuple[int, ...] = ()


def calibrate_clip(clip: Path, board: CharucoBoard) -> Calibration:
    """Intrinsics and distortion from the frames of the clip itself."""
    info = probe(clip)
    step = max(1, (info.frame_count or _CALIBRATED_FROM) // _CALIBRATED_FROM)
    detector = CharucoDetector(board)
    greys = islice(read_greys(clip, info.width_px, info.height_px), 0, None, step)
    seen = [detector.detect(grey) for grey, _ in with_progress(greys, "calibrating", (info.frame_count or 0) // step)]
    return calibrated(board, seen, info.width_px, info.height_px)


def track_board(
    clip: Path, board: CharucoBoard, camera: Camera, distortion: Distortion | None = None, settings: TrackSettings | None = None
) -> BoardTrack:
    """camera: intrinsics, made those of the clip's pictures. Raises InputError where these have another shape and where the board is never
    seen."""
    settings, info = settings or TrackSettings(), probe(clip)
    intrinsics = intrinsics_of_clip(Intrinsics(camera, distortion), (info.width_px, info.height_px), info.quarter_turns, clip)
    camera, distortion = intrinsics.camera, intrinsics.distortion
    undistorted, times_s = Undistorting(camera, distortion), []

    def greys() -> Iterator[Grey]:
        frames = read_greys(clip, info.width_px, info.height_px)
        for grey, time_s in with_progress(frames, "tracking the board", info.frame_count or 0):
            times_s.append(time_s)
            yield undistorted(grey)

    corners = RollingCorners(board).all(greys())
    fits = poses_of(corners, board, camera, times_s)
    if len(fits) < 2:
        raise InputError(
            f"the board ({board.squares_text} squares, {board.dictionary}) was found in {len(fits)} of {len(corners)} frames of {clip}: "
            f"check that --board is the one in the picture, and that it is lit and sharp"
        )
    if sum(fit.is_certain for fit in fits.values()) < 2:
        raise InputError(
            f"the board was found in {len(fits)} of {len(corners)} frames of {clip}, but so small, or so much head on, that nobody can "
            f"tell how it is tilted: film it from nearer, or more from the side, or print a larger one"
        )
    return _judged(corners, fits, _Shot(board, camera, distortion, tuple(times_s)), settings)


def poses_of(corners: Sequence[Corners], board: CharucoBoard, camera: Camera, times_s: Sequence[float]) -> dict[int, PoseFit]:
    """By frame; of two poses that explain a frame alike the one that fits into the whole shot is taken."""
    found = {number: poses_from_plane(board.corners_m[each.ids], each.xy_px, camera) for number, each in enumerate(corners)}
    return fits_of_shot({number: each for number, each in found.items() if each is not None}, times_s)


@dataclass(frozen=True)
class _Shot:
    board: CharucoBoard
    camera: Camera
    distortion: Distortion | None
    times_s: tuple[float, ...]


def _judged(corners: Sequence[Corners], found: dict[int, PoseFit], shot: _Shot, settings: TrackSettings) -> BoardTrack:
    fits = {number: fit for number, fit in found.items() if fit.is_certain}
    observed = {number: Observation(fit.camera_from_world, corners[number].only(fit.inliers)) for number, fit in fits.items()}
    steady = steadied(observed, shot.board, shot.camera, settings.extra_px)
    measured = {number: each.pose for number, each in observed.items()}
    bridged = [number for number in steady if number not in fits and _gap(number, fits) <= settings.longest_gap]
    poses = {number: steady[number] if settings.smooth else measured[number] for number in fits} | {n: steady[n] for n in bridged}
    frames = {
        number: TrackedFrame(
            replace(shot.camera, camera_from_world=poses[number]), time_s=shot.times_s[number], distortion=shot.distortion or None
        )
        for number in sorted(poses)
    }
    lost = tuple(number for number in range(len(corners)) if number not in poses)
    after_px, before_px = (residual_px(observed, each, shot.board, shot.camera) for each in (poses, measured))
    return BoardTrack(
        CameraTrack(frames, "-z"),
        len(corners),
        len(fits),
        tuple(sorted(bridged)),
        lost,
        after_px,
        before_px,
        tuple(sorted(set(found) - set(fits))),
    )


def _gap(number: int, fits: dict[int, PoseFit]) -> int:
    """How many frames around this one are missing."""
    before, after = number, number
    while before not in fits:
        before -= 1
    while after not in fits:
        after += 1
    return after - before - 1
