"""Calibration of a phone on the hot shoe while both it and the camera see one board: pairs of poses, then the rig.

Two streams come with delays of their own, which nobody knows; where both have stood still for longer than the delays differ, the
poses are of one place. Over such a moment they are averaged (StillPairs).
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from threading import Event

import numpy as np
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import MM_PER_M
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import inverted, rigid
from viewfinder.frames import CameraFrame, Pose
from viewfinder.tracking.phone_rig import FEWEST_PAIRS, PhoneRig, PosePair, angle_deg, calibrate_rig
from viewfinder.tracking.phone_tracker import PhoneFrames, PhoneTracker
from viewfinder.tracking.tracker import Tracker

_FEWEST = 4


@dataclass(frozen=True)
class Stillness:
    """Limits of a moment that makes a pair.

    still_s: how long both must stand still, within moved_deg and moved_mm of the mean. apart_deg, apart_mm: two pairs differ by one
    of them at least. late_s: how long a pose of the camera waits for that of the phone.
    """

    still_s: float = 0.6
    moved_deg: float = 0.8
    moved_mm: float = 6.0
    apart_deg: float = 3.0
    apart_mm: float = 20.0
    late_s: float = 1.0


class StillPairs:
    """Pairs of moments at which both stand still; `take` gets every pose of the camera, in order. pairs: those found so far."""

    def __init__(self, phone_pose: Callable[[float], Pose | None], stillness: Stillness | None = None) -> None:
        """Begin without pairs. phone_pose: phone_from_world at a time of the camera's frames, None where it is not known (yet)."""
        self.pairs: list[PosePair] = []
        self._phone_pose, self._limits = phone_pose, stillness or Stillness()
        self._waiting: deque[tuple[float, Pose]] = deque()
        self._moment: deque[tuple[float, PosePair]] = deque()

    def take(self, time_s: float, camera_from_world: Pose | None) -> bool:
        """Return True if that made a new pair. None: the camera does not see the board, which ends the moment."""
        if camera_from_world is None:
            self._waiting.clear()
            self._moment.clear()
            return False
        self._waiting.append((time_s, camera_from_world))
        while self._waiting and (phone := self._phone_pose(self._waiting[0][0])) is not None:
            when_s, camera = self._waiting.popleft()
            self._moment.append((when_s, PosePair(phone, camera)))
        if self._waiting and time_s - self._waiting[0][0] > self._limits.late_s:
            self._waiting.popleft()
            self._moment.clear()
        return self._found()

    def _found(self) -> bool:
        limits, moment = self._limits, self._moment
        while len(moment) > 1 and moment[-1][0] - moment[1][0] >= limits.still_s:
            moment.popleft()
        if len(moment) < _FEWEST or moment[-1][0] - moment[0][0] < limits.still_s:
            return False
        pair = _mean_pair([each for _, each in moment])
        still = all(self._is_near(pair, each, limits.moved_deg, limits.moved_mm) for _, each in moment)
        known = any(self._is_near(pair, each, limits.apart_deg, limits.apart_mm, by_both=False) for each in self.pairs)
        if not still or known:
            return False
        self.pairs.append(pair)
        return True

    @staticmethod
    def _is_near(a: PosePair, b: PosePair, degrees: float, millimetres: float, by_both: bool = True) -> bool:
        """Compare the camera's poses, and the phone's too if by_both."""
        poses = [(a.camera_from_world, b.camera_from_world)] + ([(a.phone_from_world, b.phone_from_world)] if by_both else [])
        return all(angle_deg(one @ inverted(other)) <= degrees and _apart_mm(one, other) <= millimetres for one, other in poses)


def _apart_mm(one: Pose, other: Pose) -> float:
    """Return the distance of the two places, not of the last columns, which turn with the camera."""
    return float(np.linalg.norm(inverted(one)[:3, 3] - inverted(other)[:3, 3])) * MM_PER_M


def _mean_pair(pairs: Sequence[PosePair]) -> PosePair:
    return PosePair(_mean([each.phone_from_world for each in pairs]), _mean([each.camera_from_world for each in pairs]))


def _mean(poses: Sequence[Pose]) -> Pose:
    """Average poses that hardly differ: the mean rotation, and the median of the places."""
    turn = Rotation.from_matrix(np.array([each[:3, :3] for each in poses])).mean().as_matrix()
    place = np.median([inverted(each)[:3, 3] for each in poses], axis=0)
    return rigid(turn, -turn @ place)


_UNSEEN_S = 2.0


@dataclass(frozen=True)
class Calibration:
    """Calibration of a phone.

    source, tracker: of the camera; intrinsics: for a size in pixels. phone: a PhoneTracker without a rig. say: gets sentences
    for people. pairs: after so many it ends; after longest_s it ends with those that there are.
    """

    source: PhoneFrames
    tracker: Tracker
    intrinsics: Callable[[int, int], Camera]
    phone: PhoneTracker
    say: Callable[[str], object]
    pairs: int = 12
    longest_s: float = 300.0

    def run(self, stopping: Event) -> PhoneRig:
        """Collect pairs in the thread of the caller. InputError where there are too few pairs, or where they contradict one another."""
        found, told = StillPairs(self.phone.phone_pose), _Unseen(self)
        started_s: float | None = None
        for frame in self.source.frames(stopping):
            started_s = frame.captured_s if started_s is None else started_s
            pose = self.tracker.track(frame, self.intrinsics(frame.bgr.shape[1], frame.bgr.shape[0]))
            # A pose that is held after the board was lost says nothing of this moment.
            seen = pose is not None and pose.is_certain and pose.captured_s == frame.captured_s
            told.frame(frame, seen)
            if found.take(frame.captured_s, pose.camera_from_world if pose is not None and seen else None):
                self.say(self._progress(found))
            if self.phone.failure is not None:
                raise InputError(f"the phone on the camera: {self.phone.failure}")
            if len(found.pairs) >= self.pairs or frame.captured_s - started_s > self.longest_s:
                break
        return calibrate_rig(found.pairs)

    def _progress(self, found: StillPairs) -> str:
        counted = f"pair {len(found.pairs)} of {self.pairs}"
        if len(found.pairs) < FEWEST_PAIRS:
            return f"{counted}: move the camera to another view of the board, and hold still"
        try:
            rig = calibrate_rig(found.pairs)
        except InputError as error:
            return f"{counted}: {error}"
        return f"{counted}: phone and camera agree within {rig.residual_deg:.2f} degrees and {rig.residual_mm:.1f} mm"


class _Unseen:
    """Report, once each time, of which of the two does not see the board."""

    def __init__(self, calibration: Calibration) -> None:
        self._of, self._seen_s, self._said = calibration, -1.0, ""

    def frame(self, frame: CameraFrame, seen: bool) -> None:
        self._seen_s = frame.captured_s if seen or self._seen_s < 0.0 else self._seen_s
        missing = "the camera does not see the board" if frame.captured_s - self._seen_s > _UNSEEN_S else self._of.phone.remark or ""
        if missing and missing != self._said:
            self._of.say(missing)
        self._said = missing
