"""The camera track of a clip in which a printed board is seen.

The board is looked for in every frame. Corners that cannot be read are carried by flow from the frame before, and if the board is read
again afterwards, back from there; in either case the whole print is laid over the picture, which keeps carried corners from drifting.
Intrinsics that were stated for the camera are brought to the size of the clip's pictures, and turned as its metadata turn them.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.camera import Camera, have_same_shape
from mrbokeh.system.console import track as with_progress
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.board_calibration import Calibration, calibrated
from mrbokeh.tracking.camera_track.board_smoothing import Observation, residual_px, steadied
from mrbokeh.tracking.camera_track.track import DISTORTION_NAMES, CameraTrack, Distortion, TrackedFrame
from mrbokeh.tracking.charuco.detector import NO_CORNERS, Corners, Grey, flow
from mrbokeh.tracking.charuco.flat_prints import FlatPrint, finder_of
from mrbokeh.tracking.charuco.pose_branches import PoseFit, fits_of_shot
from mrbokeh.tracking.charuco.pose_from_points import FEWEST_POINTS, opencv_matrix, poses_from_plane
from mrbokeh.video.clip import probe, read_display_frames


@dataclass(frozen=True)
class Intrinsics:
    """Camera with its distortion.

    camera: its pose says nothing. distortion: None is a pinhole.
    """

    camera: Camera
    distortion: Distortion | None = None

    def turned(self, quarter_turns: int) -> "Intrinsics":
        """Return the intrinsics for pictures turned counter-clockwise by quarter turns."""
        turned = self
        for _ in range(quarter_turns % 4):
            turned = turned._turned_once()
        return turned

    def _turned_once(self) -> "Intrinsics":
        """Return the intrinsics after one quarter turn: a point (x, y) comes to (y, width - x)."""
        (fx, fy), (cx, cy), width_px = self.camera.focal_px, self.camera.principal_px, self.camera.width_px
        camera = Camera(
            width_px=self.camera.height_px,
            height_px=width_px,
            focal_px=(fy, fx),
            principal_px=(cy, width_px - cx),
            camera_from_world=np.eye(4),
        )
        if self.distortion is None:
            return Intrinsics(camera)
        p1, p2 = (self.distortion.get(name, 0.0) for name in ("p1", "p2"))
        tangential = {"p1": -p2, "p2": p1} if p1 or p2 else {}
        return Intrinsics(camera, {**{name: value for name, value in self.distortion.items() if name not in ("p1", "p2")}, **tangential})


def intrinsics_of_clip(stated: Intrinsics, size_px: tuple[int, int], quarter_turns: int, clip: Path) -> Intrinsics:
    """Return the intrinsics for the pictures of a clip.

    size_px: (width, height) of the clip's pictures as they are shown; quarter_turns: counter-clockwise, by which they were turned.
    Intrinsics stated for the camera held level hold for upright pictures too, if the clip's metadata turn them. Raises InputError if the
    pictures have another shape.
    """
    for turns in dict.fromkeys((0, quarter_turns)):
        found = stated.turned(turns)
        if have_same_shape(size_px, (found.camera.width_px, found.camera.height_px)):
            return replace(found, camera=replace(found.camera.resized(*size_px), camera_from_world=np.eye(4)))
    raise InputError(
        f"expected intrinsics for pictures of the shape of {clip} ({size_px[0]}x{size_px[1]}), got those of "
        f"{stated.camera.width_px}x{stated.camera.height_px}: state them for all of the picture, or give --calibrate"
    )


_CARRIED_FRAMES = 30
"""Longest run in which corners are carried that no print confirms; real clips blur for less, and flow has slipped by then."""

_BACK_FRAMES = 60


def read_greys(clip: Path, width_px: int, height_px: int) -> Iterator[tuple[Grey, float]]:
    """Yield (grey picture, its time in seconds) of each frame."""
    for frame in read_display_frames(clip, width_px, height_px):
        yield cv2.cvtColor(frame.bgr, cv2.COLOR_BGR2GRAY), frame.time_s


class Undistorting:
    """Undistortion of pictures to the pinhole of their lens; a homography then explains a board."""

    def __init__(self, camera: Camera, distortion: Distortion | None) -> None:
        told = opencv_coefficients(distortion)
        self._maps = None
        if told.any():
            matrix, size = opencv_matrix(camera), (camera.width_px, camera.height_px)
            matrix[:2, 2] -= 0.5  # OpenCV's first pixel has its centre at (0, 0)
            self._maps = cv2.initUndistortRectifyMap(matrix, told, None, matrix, size, cv2.CV_32FC1)

    def __call__(self, grey: Grey) -> Grey:
        return grey if self._maps is None else cv2.remap(grey, *self._maps, cv2.INTER_CUBIC)


def opencv_coefficients(distortion: Distortion | None) -> Float64[np.ndarray, "8"]:
    return np.array([(distortion or {}).get(name, 0.0) for name in DISTORTION_NAMES])


class RollingCorners:
    """Corners of frame after frame; `all` also fills the frames before the board comes back into sight."""

    def __init__(self, board: FlatPrint) -> None:
        self._finder = finder_of(board)

    def all(self, greys: Iterable[Grey]) -> list[Corners]:
        """Return the corners of each frame; none if the board is neither seen nor carried."""
        found: list[Corners] = []
        before: Grey | None = None
        waiting: list[Grey] = []
        unconfirmed = 0
        for grey in greys:
            carried = self._carried(before, grey, found[-1]) if before is not None and unconfirmed < _CARRIED_FRAMES else NO_CORNERS
            corners, confirmed = self._in_frame(grey, self._finder.detect(grey), carried)
            found.append(corners)
            unconfirmed = 0 if confirmed else unconfirmed + 1
            if len(corners) < FEWEST_POINTS:
                waiting = [*waiting[-_BACK_FRAMES:], grey]
            elif waiting:
                self._go_back(found, [*waiting, grey])
                waiting = []
            before = grey
        return found

    def _in_frame(self, grey: Grey, read: Corners, carried: Corners) -> tuple[Corners, bool]:
        """Return (corners, whether reading or the print confirms them)."""
        start = read.with_more(carried)
        aligned = self._finder.aligned(grey, start)
        if aligned is not None:
            return aligned, True
        return start, len(read) >= FEWEST_POINTS

    def _go_back(self, found: list[Corners], greys: list[Grey]) -> None:
        """Carry corners from the last frame, in which the board is seen, to those before, as far as it holds."""
        for back in range(1, len(greys)):
            place = len(found) - 1 - back
            carried = self._carried(greys[-back], greys[-back - 1], found[place + 1])
            corners, _ = self._in_frame(greys[-back - 1], found[place], carried)
            if len(corners) < FEWEST_POINTS:
                return
            found[place] = corners

    def _carried(self, start: Grey, end: Grey, corners: Corners) -> Corners:
        places, good = flow(start, end, corners.xy_px)
        return Corners(corners.ids, places).only(good)


_CALIBRATED_FROM = 240
"""Frames at most in which the board is read for calibration."""


@dataclass(frozen=True)
class TrackSettings:
    """Settings of `track_board`.

    longest_gap: so many frames without the board in sight are bridged.

    smooth: as far as the corners' own scatter leaves poses open, see `board_smoothing`. extra_px: further, so that the picture of the
      board may move by so much (RMS); it takes the trembling of a hand away, which is in the plate.
    """

    longest_gap: int = 10
    smooth: bool = True
    extra_px: float = 0.0


@dataclass(frozen=True)
class BoardTrack:
    """Track of a clip and how well it was measured.

    frame_count: of the clip. seen: frames in which the pose was measured; bridged: interpolated; lost: in neither, and not in the track.

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


def calibrate_clip(clip: Path, board: FlatPrint) -> Calibration:
    """Calibrate intrinsics and distortion from the frames of the clip itself."""
    info = probe(clip)
    step = max(1, (info.frame_count or _CALIBRATED_FROM) // _CALIBRATED_FROM)
    finder = finder_of(board)
    greys = islice(read_greys(clip, info.width_px, info.height_px), 0, None, step)
    seen = [finder.detect(grey) for grey, _ in with_progress(greys, "calibrating", (info.frame_count or 0) // step)]
    return calibrated(board, seen, info.width_px, info.height_px)


def track_board(
    clip: Path, board: FlatPrint, camera: Camera, distortion: Distortion | None = None, settings: TrackSettings | None = None
) -> BoardTrack:
    """Track a clip by its board.

    camera: intrinsics, brought to the clip's pictures. Raises InputError if these have another shape, or the board is never seen.
    """
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
            f"{board.described} was found in {len(fits)} of {len(corners)} frames of {clip}: "
            f"check that it is the one in the clip, and that it is lit and sharp"
        )
    if sum(fit.is_certain for fit in fits.values()) < 2:
        raise InputError(
            f"the board was found in {len(fits)} of {len(corners)} frames of {clip}, but so small, or so much head on, that nobody can "
            f"tell how it is tilted: film it from nearer, or more from the side, or print a larger one"
        )
    return _judged(corners, fits, _Shot(board, camera, distortion, tuple(times_s)), settings)


def poses_of(corners: Sequence[Corners], board: FlatPrint, camera: Camera, times_s: Sequence[float]) -> dict[int, PoseFit]:
    """Return the pose of each frame; of two poses that explain a frame alike the one that fits the whole shot is taken."""
    found = {number: poses_from_plane(board.corners_m[each.ids], each.xy_px, camera) for number, each in enumerate(corners)}
    return fits_of_shot({number: each for number, each in found.items() if each is not None}, times_s)


@dataclass(frozen=True)
class _Shot:
    board: FlatPrint
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
        track=CameraTrack(frames, "-z"),
        frame_count=len(corners),
        seen=len(fits),
        bridged=tuple(sorted(bridged)),
        lost=lost,
        residual_px=after_px,
        measured_residual_px=before_px,
        unsure=tuple(sorted(set(found) - set(fits))),
    )


def _gap(number: int, fits: dict[int, PoseFit]) -> int:
    """Return how many frames around this one are missing."""
    before, after = number, number
    while before not in fits:
        before -= 1
    while after not in fits:
        after += 1
    return after - before - 1
