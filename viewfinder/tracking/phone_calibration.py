"""Calibrating a phone on the hot shoe while both it and the camera see one board: pairs of poses, then the rig."""

from collections.abc import Callable
from dataclasses import dataclass
from threading import Event

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from viewfinder.flow.frames import CameraFrame
from viewfinder.tracking.base import Tracker
from viewfinder.tracking.phone_rig import FEWEST_PAIRS, PhoneRig, calibrate_in_one_world
from viewfinder.tracking.phone_tracker import PhoneFrames, PhoneTracker
from viewfinder.tracking.still_pairs import StillPairs

_UNSEEN_S = 2.0


@dataclass(frozen=True)
class Calibration:
    """source, tracker: of the camera; intrinsics: for a size in pixels. phone: a PhoneTracker without a rig. say: gets sentences
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
        """Takes its time, in the thread of the caller. InputError where there are too few pairs, or where they contradict one another."""
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
        return calibrate_in_one_world(found.pairs)

    def _progress(self, found: StillPairs) -> str:
        counted = f"pair {len(found.pairs)} of {self.pairs}"
        if len(found.pairs) < FEWEST_PAIRS:
            return f"{counted}: move the camera to another view of the board, and hold still"
        try:
            rig = calibrate_in_one_world(found.pairs)
        except InputError as error:
            return f"{counted}: {error}"
        return f"{counted}: phone and camera agree within {rig.residual_deg:.2f} degrees and {rig.residual_mm:.1f} mm"


class _Unseen:
    """Says, once each time, which of the two does not see the board."""

    def __init__(self, calibration: Calibration) -> None:
        self._of, self._seen_s, self._said = calibration, -1.0, ""

    def frame(self, frame: CameraFrame, seen: bool) -> None:
        self._seen_s = frame.captured_s if seen or self._seen_s < 0.0 else self._seen_s
        missing = "the camera does not see the board" if frame.captured_s - self._seen_s > _UNSEEN_S else self._of.phone.remark or ""
        if missing and missing != self._said:
            self._of.say(missing)
        self._said = missing
