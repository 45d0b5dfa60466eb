"""PoseHistory: the last samples of a tracking system with their times, and the pose at any time among them; SenderClock."""

from bisect import bisect_right, insort
from collections import deque
from dataclasses import dataclass
from threading import Lock

import numpy as np

from mrbokeh.tracking.camera_track.track import focus_between_m, pose_between, stop_between
from viewfinder.frames import UNKNOWN_LENS, LensState, Pose

STAGE_FROM_BOARD = np.diag([1.0, -1.0, -1.0, 1.0])
"""Our world (x right, y down the board, z into it) lies on the stage's ground: y along -Y, z along -Z."""


class MalformedMessageError(ValueError):
    """Message from the network that is not what its format says; it is counted and otherwise ignored."""


@dataclass(frozen=True)
class TrackingSample:
    """Message of an external tracking system, in our conventions.

    camera_from_world: at the entrance pupil, our axes, metres. sender_s: when it was taken, by the sender's clock; None: not said.

    ignored: what the message says and nothing here makes use of.
    """

    camera_from_world: Pose
    lens: LensState = UNKNOWN_LENS
    sender_s: float | None = None
    ignored: frozenset[str] = frozenset()


def lens_between(a: LensState, b: LensState, share: float) -> LensState:
    """Interpolate focus in dioptres and f-numbers in stops, as the rings of a lens turn; what only one knows is taken from it."""
    a, b = a.completed_by(b), b.completed_by(a)
    both_mm = a.focal_length_mm, b.focal_length_mm
    return LensState(
        focus_between_m(a.focus_distance_m, b.focus_distance_m, share),
        stop_between(a.f_number, b.f_number, share),
        None if both_mm[0] is None or both_mm[1] is None else (1.0 - share) * both_mm[0] + share * both_mm[1],
    )


@dataclass(frozen=True)
class PoseAtTime:
    """Pose at a time.

    beyond_s: by how much the time asked for lies after the sample before it, which then stands still; 0 between two samples.
    """

    camera_from_world: Pose
    lens: LensState
    beyond_s: float


class PoseHistory:
    """History, bounded and safe between threads. Times are those of `time.monotonic`; samples may come a little out of order.

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
        """Interpolate the pose; None before the first sample."""
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


class SenderClock:
    """Clock of a sender in our time.

    No packet is early: the least delayed of the last arrivals tells how the clocks differ (as in NTP's clock filter, RFC 5905). What all
    packets are late by stays in; the delay between video and pose, which the user sets, contains it.
    """

    def __init__(self, window: int = 128) -> None:
        self._differences_s: deque[float] = deque(maxlen=window)

    def ours_s(self, sender_s: float | None, arrived_s: float) -> float:
        """Return when it was sent, by our clock; a sender that says no time is taken at the arrival."""
        if sender_s is None:
            return arrived_s
        self._differences_s.append(arrived_s - sender_s)
        return sender_s + min(self._differences_s)
