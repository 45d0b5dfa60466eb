"""PhoneTracker: the camera is where the phone on it is; the phone sees a board sharply that the camera blurs."""

import logging
from collections.abc import Iterator
from threading import Event, Thread
from typing import Protocol, runtime_checkable

from mrbokeh.optics.camera import Camera
from mrbokeh.system.errors import InputError
from viewfinder.frames import CameraFrame, Pose
from viewfinder.tracking.phone_rig import PhoneRig
from viewfinder.tracking.pose_history import PoseHistory, TrackingSample
from viewfinder.tracking.tracker import TrackedPose, Tracker

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
