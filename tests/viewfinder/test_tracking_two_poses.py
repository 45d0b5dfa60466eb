"""A board that is small in the picture fits two poses: no wrong one may be shown as if it were sure, live or from a clip."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cache
from itertools import pairwise, product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from datasets_scripts.charuco_clip import BoardClip, HandHeld, Sheet
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.tracking.camera_track.board_track import poses_of
from mrbokeh.tracking.charuco.board import CharucoBoard, CharucoGrid, black_rectangles_mm
from mrbokeh.tracking.charuco.board_alignment import AlignedDetector
from mrbokeh.tracking.charuco.detector import Corners
from mrbokeh.tracking.charuco.pose_branches import CERTAIN_DEG, PoseBranches, PoseFit, fits_of_shot
from mrbokeh.tracking.charuco.pose_from_points import PlanePoses, poses_from_plane, turn_between_rad
from tests.support.told_parts import ImmediateDetections
from tests.support.traced_board_clip import BOARD, camera_frames
from viewfinder.frames import CameraFrame
from viewfinder.tracking.charuco_tracker import CharucoTracker

CAMERA = Camera(640, 360, (590.0, 590.0), (320.0, 180.0))
SMALL = CharucoBoard((CharucoGrid((6, 5), 12.0, 9.0),))
"""72 x 60 mm, 20 corners."""

NOISE_PX, FRAMES = 0.3, 60
TIMES_S = [number / 30.0 for number in range(FRAMES)]
WORST_DEG = 3.0 * CERTAIN_DEG
"""That a pose said to be certain may be off: three times the RMS error up to which it is called so."""

Fits = dict[int, PoseFit]
Both = dict[int, PlanePoses]
Shot = tuple[list[Corners], list[Camera]]
Tracking = Callable[[Both], Fits]


def shot(board: CharucoBoard, distance_m: float, elevation_deg: float, seed: int, noise_px: float = NOISE_PX) -> Shot:
    """By hand, the board beside the middle of the picture; corners where they are, plus noise."""
    x, y, _ = board.corners_m.mean(axis=0)
    motion = HandHeld((float(x) + 0.15 * distance_m, float(y), 0.0), distance_m, elevation_deg, seed=seed)
    cameras = [replace(CAMERA, camera_from_world=motion.camera_from_world(time_s)) for time_s in TIMES_S]
    rng = np.random.default_rng(seed)
    exact = [camera.project(board.corners_m)[0] for camera in cameras]
    return [Corners(np.arange(len(each)), each + rng.normal(0.0, noise_px, each.shape)) for each in exact], cameras


def both_poses(board: CharucoBoard, seen: Sequence[Corners]) -> Both:
    """Of every frame by itself."""
    found = [poses_from_plane(board.corners_m[each.ids], each.xy_px, CAMERA) for each in seen]
    return {number: each for number, each in enumerate(found) if each is not None}


def live(both: Both) -> Fits:
    """Frame by frame, each known only by those before."""
    branches = PoseBranches()
    return {number: branches.take(each, TIMES_S[number]) for number, each in both.items()}


def of_clip(both: Both) -> Fits:
    return fits_of_shot(both, TIMES_S)


def nearest_to_before(both: Both) -> Fits:
    """The peer: the better fit at first, then of two that fit within a tenth the one nearer to the frame before (as it was done)."""
    fits: Fits = {}
    for number, found in both.items():
        alike = [pose for pose in found.poses if pose.residual_px <= 1.1 * found.poses[0].residual_px + 0.03]
        if fits:
            alike.sort(key=lambda pose: turn_between_rad(pose.camera_from_world, fits[number - 1].camera_from_world))
        fits[number] = PoseFit(alike[0].camera_from_world, alike[0].residual_px, found.inliers)
    return fits


VIEWS = [(SMALL, metres, up) for metres in (0.5, 1.0, 1.5) for up in (90.0, 80.0, 60.0, 40.0, 20.0)]
VIEWS += [(BOARD, metres, up) for metres in (2.0, 3.0) for up in (90.0, 80.0, 60.0)]


@cache
def view(index: int, seed: int) -> tuple[Both, list[Camera]]:
    """One of VIEWS, which every way to track it gets alike: finding the poses takes nearly all the time."""
    seen, cameras = shot(*VIEWS[index], seed)
    return both_poses(VIEWS[index][0], seen), cameras


@cache
def errors(track: Tracking, seeds: tuple[int, ...], of_views: range = range(len(VIEWS))) -> np.ndarray:
    """(error of the rotation in degrees, whether it is called certain, index in VIEWS) of every frame."""
    rows = []
    for index, seed in product(of_views, seeds):
        both, cameras = view(index, seed)
        for number, fit in track(both).items():
            off_deg = np.rad2deg(turn_between_rad(fit.camera_from_world, cameras[number].camera_from_world))
            rows.append((off_deg, fit.is_certain, index))
    return np.array(rows)


def assert_no_flip_is_called_certain(track: Tracking, seeds: tuple[int, ...]) -> None:
    off_deg, certain, _ = errors(track, seeds).T
    assert len(off_deg) == len(VIEWS) * len(seeds) * FRAMES and off_deg[certain > 0].max() < WORST_DEG


@pytest.mark.parametrize("track", [live, of_clip])
@pytest.mark.slow
def test_no_pose_that_is_far_off_is_called_certain(track: Tracking) -> None:
    """1260 frames from 90 (head on) to 20 degrees above the board, which spans 20 to 85 px. The right pose is said to be certain
    where it can be: at 60 degrees and less, at 1 m, in more than 4 of 5 frames live."""
    assert_no_flip_is_called_certain(track, (0,))
    _, certain, index = errors(track, (0,)).T
    clear = [at for at, (board, metres, up) in enumerate(VIEWS) if ((board is SMALL and metres <= 1.0) or board is BOARD) and up <= 60.0]
    assert certain[np.isin(index, clear)].mean() > 0.8


@pytest.mark.slow
@pytest.mark.parametrize("track", [live, of_clip])
def test_no_pose_that_is_far_off_is_called_certain_in_many_shots(track: Tracking) -> None:
    """12600 frames."""
    assert_no_flip_is_called_certain(track, tuple(range(10, 20)))


@pytest.mark.slow
def test_the_same_frames_jump_without_it() -> None:
    """The frames are hard: taking the nearer pose shows wrong ones in more than 1 of 25 of all, tens of degrees off; in these alone."""
    off_deg = errors(nearest_to_before, (0,), range(5, 12))[:, 0]
    assert (off_deg > WORST_DEG).sum() > 0.04 * len(VIEWS) * FRAMES and off_deg.max() > 30.0


def test_the_expected_error_is_the_error_that_there_is() -> None:
    """Where only one pose fits: RMS of the error over what was expected, of 60 frames with their own noise, 1 +- 2 / sqrt(120)."""
    seen, cameras = shot(SMALL, 0.5, 45.0, 3)
    fits = poses_of(seen, SMALL, CAMERA, TIMES_S)
    off_deg = [np.rad2deg(turn_between_rad(fits[n].camera_from_world, camera.camera_from_world)) for n, camera in enumerate(cameras)]
    ratios = [off / fits[n].turn_sigma_deg for n, off in enumerate(off_deg)]
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.2)


def test_the_poses_of_a_clip_are_those_of_its_frames_taken_together() -> None:
    """Those that all views above are measured by."""
    seen, _ = shot(SMALL, 1.0, 60.0, 0)
    found, expected = poses_of(seen, SMALL, CAMERA, TIMES_S), of_clip(view(VIEWS.index((SMALL, 1.0, 60.0)), 0)[0])
    assert list(found) == list(expected) == list(range(FRAMES))
    for number, fit in found.items():
        np.testing.assert_array_equal(fit.camera_from_world, expected[number].camera_from_world)
        assert fit.turn_sigma_deg == expected[number].turn_sigma_deg


def test_a_single_frame_that_leaves_it_open_says_so() -> None:
    """A 6 cm grid 3 m away, tilted by 30 degrees: the other pose fits as well (perspective moves its corners by 0.1 px)."""
    unsure = [PoseBranches().take(poses_of_frame(tilted(30.0, 3.0), seed=seed), 0.0) for seed in range(5)]
    assert all(not fit.is_certain and fit.turn_sigma_deg > 10.0 for fit in unsure)


def poses_of_frame(camera_from_world: np.ndarray, noise_px: float = 0.1, seed: int = 0) -> PlanePoses:
    exact = replace(CAMERA, camera_from_world=camera_from_world).project(SMALL.corners_m)[0]
    return poses_from_plane(SMALL.corners_m, exact + np.random.default_rng(seed).normal(0.0, noise_px, exact.shape), CAMERA)


def tilted(tilt_deg: float, distance_m: float) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("x", tilt_deg, degrees=True).as_matrix()
    pose[:3, 3] = 0.0, 0.0, distance_m
    return pose


def test_what_was_seen_clearly_before_tells_the_poses_apart_until_they_meet() -> None:
    """From near (clear) to 2 m at a tilt of 40 degrees: certain all the way. Then through head on, 2 degrees a frame: at the other side
    nobody can know whether the board tilted through or back. Near again, it is certain within 3 frames, and right."""
    branches = PoseBranches()
    path = [(40.0, metres) for metres in np.linspace(0.3, 2.0, 40)]
    path += [(tilt, 2.0) for tilt in np.arange(38.0, -42.0, -2.0)]
    path += [(-40.0, metres) for metres in (1.0, 0.6, 0.5, 0.4, 0.35, 0.3)]
    fits = [branches.take(poses_of_frame(tilted(*at), seed=number), number / 30.0) for number, at in enumerate(path)]
    off_deg = [np.rad2deg(turn_between_rad(fit.camera_from_world, tilted(*at))) for fit, at in zip(fits, path, strict=True)]
    certain = np.array([fit.is_certain for fit in fits])
    assert certain[:40].all() and max(off_deg[:40]) < 5.0 and not certain[62:80].any()
    assert certain[-3:].all() and max(off_deg[-3:]) < 5.0 and max(np.array(off_deg)[certain]) < WORST_DEG


def test_while_nobody_knows_the_object_does_not_jump() -> None:
    """30 frames of a board tilted by 30 degrees 3 m away: each pose is within the noise of the one before, never the other one."""
    branches = PoseBranches()
    fits = [branches.take(poses_of_frame(tilted(30.0, 3.0), seed=seed), seed / 30.0) for seed in range(30)]
    better = [poses_of_frame(tilted(30.0, 3.0), seed=seed).poses[0].camera_from_world for seed in range(30)]
    assert not any(fit.is_certain for fit in fits)
    assert max(steps_deg([fit.camera_from_world for fit in fits])) < 25.0 < 45.0 < max(steps_deg(better))


def steps_deg(poses: Sequence[np.ndarray]) -> list[float]:
    return [float(np.rad2deg(turn_between_rad(one, other))) for one, other in pairwise(poses)]


def traced(distance_m: float, elevation_deg: float, frames: int) -> Iterator[tuple[CameraFrame, Camera]]:
    """The board of two scales, printed and traced, at 480x270."""
    motion = HandHeld((0.092, 0.12, 0.0), distance_m, elevation_deg)
    clip = BoardClip(Sheet(black_rectangles_mm(BOARD)), motion, Lens(22.0, 8.0, distance_m, 24.0), 480, 270, frames, noise=0.01, samples=8)
    return camera_frames(clip)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("distance_m", "elevation_deg", "least_shown", "least_certain"), [(1.8, 88.0, 9, 0), (1.5, 70.0, 11, 9)], ids=["head_on", "tilted"]
)
def test_a_traced_board_that_is_small_in_the_picture_is_not_shown_flipped(
    distance_m: float, elevation_deg: float, least_shown: int, least_certain: int
) -> None:
    """Through detection, alignment and flow, whose errors of 0.1 px corners share: no white noise. The board spans 60 px of 480 head on, 67
    tilted. Of 10 seeds of the hand, 9 hold head on (up to 7.6 degrees off; the tenth is found in 6 frames) and 10 tilted: up to 0.8 degrees
    off, where the other pose of every frame is 39 degrees and more away. (At 60 degrees from 1.8 m most seeds find no board at all.)"""
    tracker = CharucoTracker(BOARD, ImmediateDetections(AlignedDetector(BOARD), every=3))
    followed = [(tracker.track(frame, true), true) for frame, true in traced(distance_m, elevation_deg, 12)]
    poses = [(pose, true) for pose, true in followed if pose is not None]
    off_deg = [np.rad2deg(turn_between_rad(pose.camera_from_world, true.camera_from_world)) for pose, true in poses if pose.is_certain]
    assert len(poses) >= least_shown and len(off_deg) >= least_certain and max(off_deg, default=0.0) < WORST_DEG
    assert all(pose.is_certain or pose.quality < 0.3 for pose, _ in poses)
