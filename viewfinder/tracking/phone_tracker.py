"""PhoneTracker: the camera is where the phone on it is; the phone sees a board sharply that the camera blurs.

The rig is calibrated while both see one board, from pairs of poses. Two streams come with delays of their own, which nobody knows; where
both have stood still for longer than the delays differ, the poses are of one place. Over such a moment they are averaged (StillPairs).
"""

import logging
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from threading import Event, Thread
from typing import Protocol, runtime_checkable

import numpy as np
from scipy.spatial.transform import Rotation

from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import MM_PER_M
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import inverted, rigid
from viewfinder.frames import CameraFrame, Pose
from viewfinder.tracking.phone_rig import FEWEST_PAIRS, PhoneRig, PosePair, angle_deg, calibrate_rig
from viewfinder.tracking.pose_history import PoseHistory, TrackingSample
from viewfinder.tracking.tracker import TrackedPose, Tracker

_FEWEST = 4
_LEAVE_S = 3.0
_ASPECT_TOLERANCE = 0.01

log = logging.getLogger(__name__)


@runtime_checkable
class PhoneFrames(Protocol):
    """Frames of the phone: any FrameSource of viewfinder/sources."""

    name: str

    @property
    def status(self) -> str | None: ...

    def frames(self, stopping: Event) -> Iterator[CameraFrame]: ...


class PhoneTracker:
    """Tracker by a phone. phone_tracker: any Tracker, which gets the phone's frames in a thread of its own and `phone_intrinsics`.

    rig: None while it is being calibrated; nothing is tracked then, `phone_pose` serves. video_delay_s: how much later the camera's
    picture of a moment comes than the phone's; may be set at any time. failure: one sentence if the phone's frames ended in an error.
    """

    def __init__(
        self, source: PhoneFrames, phone_tracker: Tracker, phone_intrinsics: Camera, rig: PhoneRig | None, hold_s: float = 0.1
    ) -> None:
        self.name, self.rig = f"phone ({source.name})", rig
        self.video_delay_s, self._hold_s = 0.0, hold_s
        self.failure: str | None = None
        self._wrong_size: str | None = None
        self.source, self._tracker, self._intrinsics = source, phone_tracker, phone_intrinsics
        self._history, self._newest = PoseHistory(joined_s=2.0 * hold_s), (0.0, 0.0, 0)
        self._looked_s = 0.0
        self._stopping = Event()
        self._thread = Thread(target=self._run, name="phone", daemon=True)
        self._thread.start()

    def track(self, frame: CameraFrame, intrinsics: Camera) -> TrackedPose | None:  # noqa: ARG002
        rig = self.rig
        found = self._history.at(frame.captured_s - self.video_delay_s)
        if rig is None or found is None or found.beyond_s >= self._hold_s:
            return None
        quality, residual_px, points = self._newest
        pose = rig.camera_from_phone @ found.camera_from_world
        return TrackedPose(
            camera_from_world=pose,
            quality=quality * (1.0 - found.beyond_s / self._hold_s),
            captured_s=frame.captured_s,
            residual_px=residual_px,
            points=points,
        )

    @property
    def remark(self) -> str | None:
        """Sentence where something is wrong: the phone's camera is away or failed, is held otherwise, or does not see the board."""
        trouble = self.failure or self.source.status or self._wrong_size
        if trouble is not None:
            return f"the phone on the camera: {trouble}"
        # In this order: a pose that comes in between is only newer than what was looked at.
        looked_s, newest_s = self._looked_s, self._history.newest_s
        unseen = looked_s - (newest_s or 0.0) > self._hold_s
        return "the phone on the camera does not see what it tracks" if unseen else None

    def phone_pose(self, captured_s: float) -> Pose | None:
        """Return phone_from_world at the time of a frame of the camera, for pairs to calibrate with; None where it is not known."""
        found = self._history.at(captured_s - self.video_delay_s)
        return None if found is None or found.beyond_s > 0.0 else found.camera_from_world

    def close(self) -> None:
        self._stopping.set()
        self._thread.join(_LEAVE_S)
        self._tracker.close()

    def _run(self) -> None:
        try:
            for frame in self.source.frames(self._stopping):
                self._take(frame)
        except InputError as error:
            self.failure = str(error)
        except Exception:
            log.exception("the phone failed")
            self.failure = f"{self.name} failed; see the terminal"

    def _take(self, frame: CameraFrame) -> None:
        height_px, width_px = frame.bgr.shape[:2]
        self._wrong_size = self._objection(width_px, height_px)
        if self._wrong_size is not None:
            return
        pose = self._tracker.track(frame, self._intrinsics.resized(width_px, height_px))
        # A tracker may give its last pose again for a while; that tells nothing new of this moment.
        if pose is not None and pose.is_certain and pose.captured_s == frame.captured_s:
            self._newest = (pose.quality, pose.residual_px, pose.points)
            self._history.add(frame.captured_s, TrackingSample(pose.camera_from_world))
        # Only now: a frame that is still looked at is not one in which nothing was seen.
        self._looked_s = frame.captured_s

    def _objection(self, width_px: int, height_px: int) -> str | None:
        """Refuse another shape of frames: a phone that is turned shows another part of its sensor. Intrinsics follow the size alone."""
        known = self._intrinsics
        if abs(width_px * known.height_px / (height_px * known.width_px) - 1.0) <= _ASPECT_TOLERANCE:
            return None
        return (
            f"its pictures are {width_px}x{height_px} px, those of its camera file {known.width_px}x{known.height_px} px: hold it as there"
        )


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
