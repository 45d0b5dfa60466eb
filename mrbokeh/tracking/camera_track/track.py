"""CameraTrack: the camera of each frame of a shot."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.camera_track.between_frames import between
from mrbokeh.tracking.camera_track.tracked_frame import TrackedFrame
from mrbokeh.tracking.upright import UPRIGHT_FROM_WORLD


@dataclass(frozen=True)
class CameraTrack:
    """frames: by number, all of one size. up: which axis of its world points up, one of UPRIGHT_FROM_WORLD (staging/upright.py).

    metric: lengths are metres; False where nobody knows the unit (structure from motion).
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
        """Of all frames, growing."""
        return sorted(self.frames)

    @property
    def size_px(self) -> tuple[int, int]:
        """(width, height)."""
        camera = self.frames[self.numbers[0]].camera
        return camera.width_px, camera.height_px

    def at(self, frame: int) -> TrackedFrame:
        """Raises InputError where the track does not hold that frame."""
        if self.fixed:
            return self.frames[self.numbers[0]]
        if frame not in self.frames:
            numbers = self.numbers
            within = "but not all of them" if len(numbers) <= numbers[-1] - numbers[0] else "which is all"
            raise InputError(
                f"the camera track has frames {numbers[0]} to {numbers[-1]} ({within}), not frame {frame}: "
                f"track that part too, or take frames that it has"
            )
        return self.frames[frame]

    def at_time(self, time_s: float | int) -> TrackedFrame:
        """Interpolated between the two frames around that time; outside, and where frames have no times, an InputError."""
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
        """With times from frame numbers: frame 0 at 0 s."""
        if not 0.0 < frame_rate < float("inf"):
            raise InputError(f"a frame rate must be a positive number of frames per second, got {frame_rate}")
        return replace(self, frames={number: replace(each, time_s=number / frame_rate) for number, each in self.frames.items()})

    def shifted(self, offset: int) -> "CameraTrack":
        """Frame n becomes n + offset, for files that count from 1 or 1001; times stay."""
        return replace(self, frames={number + offset: each for number, each in self.frames.items()})

    def resized(self, width_px: int, height_px: int) -> "CameraTrack":
        """The same views in another number of pixels; distortion does not depend on it."""
        frames = {number: replace(each, camera=each.camera.resized(width_px, height_px)) for number, each in self.frames.items()}
        return replace(self, frames=frames)

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
    """A camera on a tripod."""
    return CameraTrack({0: TrackedFrame(camera)}, up, fixed=True)


def is_rigid(pose: np.ndarray) -> bool:
    """Whether a matrix is a rotation and a shift."""
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        return False
    turn = pose[:3, :3]
    return bool(
        np.allclose(turn @ turn.T, np.eye(3), atol=1e-4) and np.linalg.det(turn) > 0 and np.allclose(pose[3], (0, 0, 0, 1), atol=1e-9)
    )
