"""PoseHistory: the last poses of a tracking system with their times, and the pose at any time among them."""

from bisect import bisect_right, insort
from dataclasses import dataclass
from threading import Lock

from mrbokeh.tracking.camera_track.between_frames import pose_between
from viewfinder.flow.frames import LensState, Pose
from viewfinder.tracking.tracking_sample import TrackingSample, lens_between


@dataclass(frozen=True)
class PoseAtTime:
    """beyond_s: by how much the time asked for lies after the sample before it, which then stands still; 0 between two samples."""

    camera_from_world: Pose
    lens: LensState
    beyond_s: float


class PoseHistory:
    """Bounded and safe between threads. Times are those of `time.monotonic`; samples may come a little out of order.

    joined_s: samples farther apart have nothing known between them; the one before then stands still.
    """

    def __init__(self, longest: int = 256, joined_s: float = 0.5) -> None:
        self._longest, self._joined_s, self._lock = longest, joined_s, Lock()
        self._times: list[float] = []
        self._samples: dict[float, TrackingSample] = {}

    def add(self, time_s: float, sample: TrackingSample) -> None:
        with self._lock:
            if time_s not in self._samples:
                insort(self._times, time_s)
            self._samples[time_s] = sample
            while len(self._times) > self._longest:
                del self._samples[self._times.pop(0)]

    @property
    def newest_s(self) -> float | None:
        with self._lock:
            return self._times[-1] if self._times else None

    def at(self, time_s: float) -> PoseAtTime | None:
        """Interpolated; None before the first sample."""
        with self._lock:
            after = bisect_right(self._times, time_s)
            if after == 0:
                return None
            before_s = self._times[after - 1]
            before = self._samples[before_s]
            if after == len(self._times) or self._times[after] - before_s > self._joined_s:
                return PoseAtTime(before.camera_from_world, before.lens, time_s - before_s)
            after_s = self._times[after]
            following = self._samples[after_s]
        share = (time_s - before_s) / (after_s - before_s)
        pose = pose_between(before.camera_from_world, following.camera_from_world, share)
        return PoseAtTime(pose, lens_between(before.lens, following.lens, share), 0.0)
