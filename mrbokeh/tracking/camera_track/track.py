"""CameraTrack: the camera of each frame of a shot, what lies between two frames, and what files do not say of themselves.

Between frames rotations go along the shortest arc (Shoemake 1985), places of the entrance pupil along a line: the last column of
camera_from_world turns with the camera, and a turning camera on a tripod would leave it. Focus goes linearly in dioptres, as rings
of lenses and the blur do, the aperture in stops.
"""

import re
from collections.abc import Callable, Container, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import UPRIGHT_FROM_WORLD

Distortion = Mapping[str, float]
"""Coefficients by their names in OpenCV and COLMAP: k1, k2, k3 (of r^2, r^4, r^6), k4, k5, k6 (the same below the bar), p1, p2."""

DISTORTION_NAMES = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
"""Names of the coefficients in OpenCV's order."""


@dataclass(frozen=True)
class TrackedFrame:
    """Camera, lens state and distortion at one moment.

    focus_distance_m: from the entrance pupil, inf is allowed. time_s: from the start of the shot. None is not known.

    distortion: from the pinhole's picture to the real one; None or empty is a pinhole.
    """

    camera: Camera
    focus_distance_m: float | None = None
    f_number: float | None = None
    time_s: float | None = None
    distortion: Distortion | None = None

    def __post_init__(self) -> None:
        for name, value in (("focus distance", self.focus_distance_m), ("f-number", self.f_number)):
            if value is not None and not value > 0.0:
                raise InputError(f"the {name} of a frame must be positive, got {value}")
        if unknown := set(self.distortion or {}) - set(DISTORTION_NAMES):
            raise InputError(f"lens distortion is given by {', '.join(DISTORTION_NAMES)}, got {', '.join(sorted(unknown))}")

    @property
    def coefficients(self) -> dict[str, float]:
        """Return the distortion coefficients that are not 0."""
        return {name: float(value) for name, value in (self.distortion or {}).items() if value}


Pose = Float64[np.ndarray, "4 4"]


def between(one: TrackedFrame, other: TrackedFrame, share: float) -> TrackedFrame:
    """Interpolate two frames: share 0 is one, 1 is the other; what only one of them knows is not known in between."""
    return TrackedFrame(
        camera=camera_between(one.camera, other.camera, share),
        focus_distance_m=focus_between_m(one.focus_distance_m, other.focus_distance_m, share),
        f_number=stop_between(one.f_number, other.f_number, share),
        time_s=_linear(one.time_s, other.time_s, share),
        distortion=_distortion(one.distortion, other.distortion, share),
    )


def camera_between(one: Camera, other: Camera, share: float) -> Camera:
    pose = pose_between(one.camera_from_world, other.camera_from_world, share)
    focal, principal = (
        tuple((1.0 - share) * x + share * y for x, y in zip(*pair, strict=True))
        for pair in ((one.focal_px, other.focal_px), (one.principal_px, other.principal_px))
    )
    return Camera(
        width_px=one.width_px,
        height_px=one.height_px,
        focal_px=(focal[0], focal[1]),
        principal_px=(principal[0], principal[1]),
        camera_from_world=pose,
    )


def pose_between(one: Pose, other: Pose, share: float) -> Pose:
    """Interpolate two camera_from_world."""
    from scipy.spatial.transform import Rotation  # here, for workers of a video seldom need it and it takes a third of their start

    a, b = np.linalg.inv(one), np.linalg.inv(other)
    turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3]).as_rotvec()
    pose = np.eye(4)
    pose[:3, :3] = (a[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()).T
    pose[:3, 3] = -pose[:3, :3] @ ((1.0 - share) * a[:3, 3] + share * b[:3, 3])
    return pose


def focus_between_m(one_m: float | None, other_m: float | None, share: float) -> float | None:
    if one_m is None or other_m is None:
        return None
    dioptres = (1.0 - share) / one_m + share / other_m
    return 1.0 / dioptres if dioptres > 0.0 else float("inf")


def stop_between(one: float | None, other: float | None, share: float) -> float | None:
    if one is None or other is None:
        return None
    return float(one ** (1.0 - share) * other**share)


def _linear(one: float | None, other: float | None, share: float) -> float | None:
    return None if one is None or other is None else (1.0 - share) * one + share * other


def _distortion(one: Distortion | None, other: Distortion | None, share: float) -> Distortion | None:
    """Interpolate coefficients; a missing one is 0."""
    if one is None and other is None:
        return None
    a, b = one or {}, other or {}
    return {name: (1.0 - share) * a.get(name, 0.0) + share * b.get(name, 0.0) for name in {**a, **b}}


@dataclass(frozen=True)
class CameraTrack:
    """Cameras of the frames of a shot.

    frames: by number, all of one size. up: which axis of its world points up, one of UPRIGHT_FROM_WORLD (mrbokeh.tracking.world_axes).
    metric: lengths are metres; False if nobody knows the unit (structure from motion).
    fixed: a camera on a tripod: its only frame stands for every number and time.
    """

    frames: Mapping[int, TrackedFrame]
    up: str = "-z"
    metric: bool = True
    fixed: bool = False

    def __post_init__(self) -> None:
        if not self.frames or (self.fixed and len(self.frames) > 1):
            raise InputError(f"a camera track needs {'just one frame' if self.fixed else 'a frame at least'}, got {len(self.frames)}")
        if self.up not in UPRIGHT_FROM_WORLD:
            raise InputError(f"the axis that points up must be one of {', '.join(UPRIGHT_FROM_WORLD)}, got {self.up!r}")
        if len(sizes := {(each.camera.width_px, each.camera.height_px) for each in self.frames.values()}) > 1:
            raise InputError(f"all frames of a camera track need one size, got {sorted(sizes)}: split the track")
        for number, each in self.frames.items():
            if not is_rigid(each.camera.camera_from_world):
                raise InputError(f"the pose of frame {number} must be a rotation and a shift (4x4), but it is not: check the file")

    @cached_property
    def numbers(self) -> list[int]:
        """Return the numbers of all frames, ascending."""
        return sorted(self.frames)

    @property
    def size_px(self) -> tuple[int, int]:
        """Return (width, height)."""
        camera = self.frames[self.numbers[0]].camera
        return camera.width_px, camera.height_px

    def at(self, frame: int) -> TrackedFrame:
        """Return a frame. Raises InputError if the track does not hold it."""
        if self.fixed:
            return self.frames[self.numbers[0]]
        if frame not in self.frames:
            numbers = self.numbers
            within = "but not all of them" if len(numbers) <= numbers[-1] - numbers[0] else "which is all"
            raise InputError(
                f"the camera track has frames {numbers[0]} to {numbers[-1]} ({within}), not frame {frame}: "
                f"track that part too, take frames that it has, or shift its numbers: mrbokeh track convert --frame-offset"
            )
        return self.frames[frame]

    def at_time(self, time_s: float | int) -> TrackedFrame:
        """Interpolate the two frames around a time. Raises InputError outside of the track, and if frames have no times."""
        if self.fixed:
            return replace(self.frames[self.numbers[0]], time_s=float(time_s))
        times_s = self._times_s
        if not times_s[0] <= time_s <= times_s[-1]:
            raise InputError(f"the camera track goes from {times_s[0]:.4f} s to {times_s[-1]:.4f} s, but was asked for {time_s:.4f} s")
        after = min(max(int(np.searchsorted(times_s, time_s)), 1), len(times_s) - 1)
        if len(times_s) == 1:
            return self.frames[self.numbers[0]]
        share = (time_s - times_s[after - 1]) / (times_s[after] - times_s[after - 1])
        one, other = (self.frames[self.numbers[index]] for index in (after - 1, after))
        return replace(between(one, other, float(share)), time_s=float(time_s))

    def timed(self, frame_rate: float | int) -> "CameraTrack":
        """Return the track with times from frame numbers: frame 0 at 0 s."""
        if not 0.0 < frame_rate < float("inf"):
            raise InputError(f"a frame rate must be a positive number of frames per second, got {frame_rate}")
        return replace(self, frames={number: replace(each, time_s=number / frame_rate) for number, each in self.frames.items()})

    def shifted(self, offset: int) -> "CameraTrack":
        """Return the track in which frame n is n + offset, for files that count from 1 or 1001; times stay."""
        return replace(self, frames={number + offset: each for number, each in self.frames.items()})

    def resized(self, width_px: int, height_px: int) -> "CameraTrack":
        """Return the same views in another number of pixels; distortion does not depend on it."""
        frames = {number: replace(each, camera=each.camera.resized(width_px, height_px)) for number, each in self.frames.items()}
        return replace(self, frames=frames)

    def with_up(self, up: str) -> "CameraTrack":
        """Return the same cameras in a world turned about its origin, such that `up` is up."""
        if up == self.up:
            return self
        old_from_new = UPRIGHT_FROM_WORLD[self.up].T @ UPRIGHT_FROM_WORLD[up]
        frames = {
            number: replace(each, camera=replace(each.camera, camera_from_world=each.camera.camera_from_world @ old_from_new))
            for number, each in self.frames.items()
        }
        return replace(self, frames=frames, up=up)

    @cached_property
    def _times_s(self) -> Float64[np.ndarray, " frames"]:
        times = [self.frames[number].time_s for number in self.numbers]
        if any(each is None for each in times):
            raise InputError("the camera track has no times: give it a frame rate, or ask by frame number")
        times_s = np.array(times, np.float64)
        if (np.diff(times_s) <= 0).any():
            raise InputError("the times of a camera track must grow with its frame numbers, but they do not: check the file")
        return times_s


def fixed_track(camera: Camera, up: str = "-z") -> CameraTrack:
    """Return the track of a camera on a tripod."""
    return CameraTrack({0: TrackedFrame(camera)}, up, fixed=True)


def is_rigid(pose: np.ndarray) -> bool:
    """Return whether a matrix is a rotation and a shift."""
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        return False
    turn = pose[:3, :3]
    return bool(
        np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) and np.linalg.det(turn) > 0 and np.allclose(pose[3], (0, 0, 0, 1), atol=1e-9)
    )


ROTATION_ORDERS = ("XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX")


@dataclass(frozen=True)
class TrackOptions:
    """Facts that a file of cameras does not state; None leaves them to the format.

    up: axis of the file's world that points up. size_px: (width, height) of the pictures. rotation_order: of a .chan, first
      rotation first. sensor_width_mm: of OpenTrackIO samples that lack it. metric: whether its lengths are metres.
    keep_distortion: False drops a lens distortion, which would else be an error if it cannot be read.
    """

    up: str | None = None
    size_px: tuple[int, int] | None = None
    rotation_order: str = "ZXY"
    sensor_width_mm: float | None = None
    metric: bool | None = None
    keep_distortion: bool = True

    def __post_init__(self) -> None:
        for name, value, choices in (("rotation-order", self.rotation_order, ROTATION_ORDERS), ("up", self.up, tuple(UPRIGHT_FROM_WORLD))):
            if value is not None and value not in choices:
                raise InputError(f"--{name} must be one of {', '.join(choices)}, got {value!r}")

    def is_metric(self, usual: bool) -> bool:
        return usual if self.metric is None else self.metric


_FACTS: dict[str, Callable[[TrackedFrame], bool]] = {
    "focus distances": lambda each: each.focus_distance_m is not None,
    "f-numbers": lambda each: each.f_number is not None,
    "times": lambda each: each.time_s is not None,
    "lens distortion": lambda each: bool(each.coefficients),
    "principal points off the middle": lambda each: not _centred(each),
    "pixels that are not square": lambda each: abs(each.camera.focal_px[0] / each.camera.focal_px[1] - 1.0) > 1e-9,
}


def lost(track: CameraTrack, kept: Container[str] = ()) -> tuple[str, ...]:
    """Return what the track knows and a file that holds only `kept` does not."""
    told = [name for name, knows in _FACTS.items() if any(knows(each) for each in track.frames.values())]
    return tuple(name for name in told if name not in kept)


def _centred(each: TrackedFrame) -> bool:
    middle = each.camera.width_px / 2.0, each.camera.height_px / 2.0
    return max(abs(a - b) for a, b in zip(each.camera.principal_px, middle, strict=True)) < 1e-9


def frame_numbers(names: Sequence[str]) -> list[int]:
    """Return the last number in each name (frame_00012.png is 12); if one has none, or two have the same, places in the order of names."""
    found = [re.findall(r"\d+", PurePosixPath(name.replace("\\", "/")).stem) for name in names]
    numbers = [int(each[-1]) for each in found if each]
    if len(numbers) == len(set(numbers)) == len(names):
        return numbers
    place = {name: index for index, name in enumerate(sorted(names))}
    return [place[name] for name in names]


def picture_name(number: int) -> str:
    """Return a name from which `frame_numbers` reads the number; no name holds a negative number."""
    return f"frame_{number:06d}.png"
