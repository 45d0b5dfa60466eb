"""The camera track of a clip in which a printed board is seen.

The board is looked for in every frame. Corners that cannot be read are carried by flow from the frame before, and if the board is read
again afterwards, back from there; in either case the whole print is laid over the picture, which keeps carried corners from drifting.
Intrinsics that were stated for the camera are brought to the size of the clip's pictures, and turned as its metadata turn them.

Poses are smoothed without lag, as strongly as the scatter of the board's corners leaves them open, and no more. Six parameters fitted to n
corners that are each off by r px are themselves off by r sqrt(6 / 2n) px in the picture (RMS). The strongest splines are taken whose poses
move the picture of the board by no more: noise goes, and the trembling of a hand, which the plate shows too, stays.

The splines are smoothing splines on the frame grid (Whittaker 1923, with third differences; Eilers 2003), for the rotation, for where the
camera sees the board's middle, and for how far off that is; filtered as a pose's last column, turn and shift would let objects swim.
Missing frames are bridged by the same splines. A criterion that looks at the poses alone (generalised cross-validation was tried) takes
the trembling of a hand for noise, and doubled the error of a traced clip.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Bool, Float64
from scipy.linalg import solveh_banded
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera, have_same_shape
from mrbokeh.system.console import track as with_progress
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.board_calibration import Calibration, calibrated
from mrbokeh.tracking.camera_track.track import DISTORTION_NAMES, CameraTrack, Distortion, TrackedFrame
from mrbokeh.tracking.charuco.detector import NO_CORNERS, Corners, Grey, flow
from mrbokeh.tracking.charuco.flat_prints import FlatPrint, finder_of
from mrbokeh.tracking.charuco.pose_branches import PoseFit, fits_of_shot
from mrbokeh.tracking.charuco.pose_from_points import FEWEST_POINTS, opencv_matrix, poses_from_plane
from mrbokeh.video.clip import probe, read_display_frames

Pose = Float64[np.ndarray, "4 4"]
Values = Float64[np.ndarray, "frames channels"]
Weights = Float64[np.ndarray, " frames"]

_ORDER = 3
_CALM = 100.0


def steady_poses(
    poses: Mapping[int, Pose], weights: Mapping[int, float], pivot_m: Float64[np.ndarray, "3"], strength: float
) -> dict[int, Pose]:
    """Return camera_from_world of every frame from the first to the last of `poses`, smoothed.

    weights: of the same frames, any unit; about 1 / variance.
    pivot_m: the world point whose direction and distance are smoothed, the middle of what was seen. strength: see `whittaker`, for
      weights of 1 at the best frame; 1 smooths over about 3 frames, 1e6 over about 30, towards 0 only gaps are filled.
    """
    numbers = np.arange(min(poses), max(poses) + 1)
    if len(poses) <= _ORDER:
        return dict(poses)
    there = np.array([int(number) in poses for number in numbers])
    known = [poses[int(number)] for number in numbers[there]]
    weight = np.zeros(len(numbers))
    weight[there] = [weights[int(number)] for number in numbers[there]]
    seen = np.array([pose[:3, :3] @ pivot_m + pose[:3, 3] for pose in known])
    channels = np.column_stack([_quaternions(known), seen[:, :2] / seen[:, 2:], np.log(seen[:, 2:])])
    smooth = _bridged(_filled(channels, there), weight / weight.max(), strength)
    return {int(number): _pose(row, pivot_m) for number, row in zip(numbers, smooth, strict=True)}


def _bridged(values: Values, weights: Weights, strength: float) -> Values:
    """Smooth, and bridge gaps by a calm spline that is moved to meet both ends: a weak one would swing with the trembling at its ends."""
    smooth, there = whittaker(values, weights, strength), weights > 0
    calm = whittaker(values, weights, max(strength, _CALM))
    meeting = calm + _filled((smooth - calm)[there], there)
    return np.where(there[:, None], smooth, meeting)


def whittaker(values: Values, weights: Weights, strength: float) -> Values:
    """Return the z that minimises sum of weights (values - z)^2 + strength times the sum of squared third differences of z."""
    count = len(values)
    bands = strength * _penalty_bands(count)
    bands[-1] += np.maximum(weights, 1e-9)
    return np.asarray(solveh_banded(bands, weights[:, None] * values))


def _penalty_bands(count: int) -> Float64[np.ndarray, "bands frames"]:
    """Return the upper bands of D'D with D the third differences, as solveh_banded has them."""
    differences = np.diff(np.eye(min(count, 4 * _ORDER)), _ORDER, axis=0)
    small = differences.T @ differences
    bands = np.zeros((_ORDER + 1, count))
    edge = len(small) // 2
    for band in range(_ORDER + 1):
        diagonal = np.diagonal(small, band)
        whole = np.full(count - band, diagonal[len(diagonal) // 2])
        if count > len(small):
            whole[:edge], whole[-edge:] = diagonal[:edge], diagonal[-edge:]
        else:
            whole = diagonal
        bands[_ORDER - band, band:] = whole
    return bands


def _quaternions(poses: list[Pose]) -> Values:
    """Return quaternions without sign changes between neighbours."""
    turns = Rotation.from_matrix(np.array([pose[:3, :3] for pose in poses])).as_quat()
    signs = np.cumprod(np.where(np.sum(turns[1:] * turns[:-1], axis=1) < 0, -1.0, 1.0))
    return turns * np.concatenate([[1.0], signs])[:, None]


def _filled(values: Float64[np.ndarray, "known channels"], there: Bool[np.ndarray, " frames"]) -> Values:
    """Fill missing rows along lines; they only start the splines, with a weight of 0."""
    places, known = np.arange(len(there)), np.flatnonzero(there)
    return np.stack([np.interp(places, known, channel) for channel in values.T], axis=1)


def _pose(row: np.ndarray, pivot_m: np.ndarray) -> Pose:
    """Return the pose of a row: quaternion, direction, logarithm of the distance."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(row[:4]).as_matrix()
    pose[:3, 3] = np.exp(row[6]) * np.array([row[4], row[5], 1.0]) - pose[:3, :3] @ pivot_m
    return pose


_WEAKEST, _STRONGEST, _STEP = 1e-4, 1e7, 2.0


@dataclass(frozen=True)
class Observation:
    """Measured pose of one frame, and the corners that it explains."""

    pose: Pose
    corners: Corners


def steadied(observed: Mapping[int, Observation], board: FlatPrint, camera: Camera, extra_px: float = 0.0) -> dict[int, Pose]:
    """Return camera_from_world of all frames from the first to the last that was observed, smoothed as far as their scatter allows.

    extra_px: RMS by which they may move further.
    """
    measured = {number: each.pose for number, each in observed.items()}
    weights = {number: float(len(each.corners)) for number, each in observed.items()}
    before_px = residual_px(observed, measured, board, camera)
    open_px = before_px * float(np.sqrt(3.0 / np.mean(list(weights.values()))))
    limit_px = float(np.hypot(before_px, open_px + extra_px))
    middle_m = board.corners_m.mean(axis=0)
    steady = steady_poses(measured, weights, middle_m, _WEAKEST)
    strength = _WEAKEST * _STEP
    while strength < _STRONGEST:
        stronger = steady_poses(measured, weights, middle_m, strength)
        if residual_px(observed, stronger, board, camera) > limit_px:
            break
        steady, strength = stronger, strength * _STEP
    return steady


def residual_px(observed: Mapping[int, Observation], poses: Mapping[int, Pose], board: FlatPrint, camera: Camera) -> float:
    """Return the RMS distance of all observed corners from where the poses put them."""
    squares = []
    for number, each in observed.items():
        seen_px, _ = replace(camera, camera_from_world=poses[number]).project(board.corners_m[each.corners.ids])
        squares.append(np.sum((seen_px - each.corners.xy_px) ** 2, axis=1))
    return float(np.sqrt(np.mean(np.concatenate(squares))))


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

    smooth: as far as the corners' own scatter leaves poses open, see `steadied`. extra_px: further, so that the picture of the
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
    residual_px: RMS distance of all corners from where the track's poses put them.
    """

    track: CameraTrack
    frame_count: int
    seen: int
    bridged: tuple[int, ...]
    lost: tuple[int, ...]
    residual_px: float
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
    return BoardTrack(
        track=CameraTrack(frames, "-z"),
        frame_count=len(corners),
        seen=len(fits),
        bridged=tuple(sorted(bridged)),
        lost=lost,
        residual_px=residual_px(observed, poses, shot.board, shot.camera),
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
