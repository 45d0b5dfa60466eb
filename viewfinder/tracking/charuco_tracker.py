"""CharucoTracker: a printed board, detected now and then in a thread, carried by flow in every frame, a pose from each."""

import logging
from dataclasses import dataclass, replace
from threading import Event, Thread
from time import monotonic
from typing import Protocol, runtime_checkable

import cv2
import numpy as np

from mrbokeh.optics.camera import Camera
from mrbokeh.tracking.charuco.board import CharucoBoard
from mrbokeh.tracking.charuco.board_alignment import AlignedDetector
from mrbokeh.tracking.charuco.detector import NO_CORNERS, Corners, FrameHistory, Grey
from mrbokeh.tracking.charuco.pose_branches import CERTAIN_DEG, PoseBranches, PoseFit
from mrbokeh.tracking.charuco.pose_from_points import poses_from_plane
from viewfinder.frames import CameraFrame, Newest
from viewfinder.tracking.tracker import TrackedPose

_POLL_S = 0.1
_LEAVE_S = 3.0

log = logging.getLogger(__name__)


@runtime_checkable
class Detector(Protocol):
    def detect(self, grey: Grey) -> Corners: ...


@dataclass(frozen=True)
class Detection:
    """Corners of the frame of that number."""

    sequence: int
    corners: Corners


@runtime_checkable
class Detections(Protocol):
    """Detection that takes frames and gives, later or at once, what was found in some of them."""

    def offer(self, sequence: int, grey: Grey, hurry: bool) -> None: ...

    def take(self) -> Detection | None: ...

    def close(self) -> None: ...


class DetectionThread:
    """Detections in a thread. every_s: between the beginnings of two searches; `hurry` (the track is lost) leaves the pause out."""

    def __init__(self, detector: Detector, every_s: float = 0.12) -> None:
        self._detector, self._every_s = detector, every_s
        self._frames: Newest[tuple[int, Grey]] = Newest()
        self._found: Newest[Detection] = Newest()
        self._next_s, self._stopping = 0.0, Event()
        self._thread = Thread(target=self._run, name="board detection", daemon=True)
        self._thread.start()

    def offer(self, sequence: int, grey: Grey, hurry: bool) -> None:
        if hurry or monotonic() >= self._next_s:
            self._next_s = monotonic() + self._every_s
            self._frames.put((sequence, grey))

    def take(self) -> Detection | None:
        return self._found.take(0.0)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join(_LEAVE_S)

    def _run(self) -> None:
        while not self._stopping.is_set():
            frame = self._frames.take(_POLL_S)
            if frame is None:
                continue
            try:
                corners = self._detector.detect(frame[1])
            except Exception:
                # One odd picture must not end tracking for good.
                log.exception("searching a frame for the board failed")
                continue
            self._found.put(Detection(frame[0], corners))


GRACE_S = 0.25
_ENOUGH_CORNERS = 16
_ENOUGH_SPREAD = 0.15
_GOOD_RESIDUAL_PX = 1.0


class CharucoTracker:
    """Tracker. grace_s: for so long after the board is lost the last pose is given again, with its own time and falling quality.

    detections: who searches frames; a DetectionThread unless given. corners: those that made the last pose.
    """

    name = "board"

    def __init__(self, board: CharucoBoard, detections: Detections | None = None, grace_s: float = GRACE_S) -> None:
        self.board, self._grace_s = board, grace_s
        self._detections = detections or DetectionThread(AlignedDetector(board))
        self._history = FrameHistory()
        self._branches = PoseBranches()
        self._last: TrackedPose | None = None
        self.corners = NO_CORNERS

    def track(self, frame: CameraFrame, intrinsics: Camera) -> TrackedPose | None:
        grey = cv2.cvtColor(frame.bgr, cv2.COLOR_BGR2GRAY)
        if not self._history.add(frame.sequence, grey):
            self.corners = NO_CORNERS
        self._detections.offer(frame.sequence, grey, hurry=not len(self.corners))
        corners = self._newest_corners()
        found = poses_from_plane(self.board.corners_m[corners.ids], corners.xy_px, intrinsics)
        if found is None:
            self.corners = NO_CORNERS
            return self._held(frame.captured_s)
        fit = self._branches.take(found, frame.captured_s)
        self.corners = corners.only(fit.inliers)
        quality = self._quality(fit, intrinsics)
        self._last = TrackedPose(
            camera_from_world=fit.camera_from_world,
            quality=quality,
            captured_s=frame.captured_s,
            residual_px=fit.residual_px,
            points=int(fit.inliers.sum()),
            is_certain=fit.is_certain,
        )
        return self._last

    def close(self) -> None:
        self._detections.close()

    def _newest_corners(self) -> Corners:
        """Return a detection, carried to this frame, before flow, which may have slipped by a square."""
        flowed = self._history.from_before(self.corners)
        detection = self._detections.take()
        if detection is None:
            return flowed
        detected = self._history.carry(detection.corners, detection.sequence)
        return flowed if detected is None else detected.with_more(flowed)

    def _held(self, now_s: float) -> TrackedPose | None:
        if self._last is None or now_s - self._last.captured_s > self._grace_s:
            self._last = None
            self._branches.reset()
            return None
        share = 1.0 - (now_s - self._last.captured_s) / self._grace_s
        return replace(self._last, quality=self._last.quality * share)

    def _quality(self, fit: PoseFit, camera: Camera) -> float:
        """Return 1 for 16 corners that fit to the pixel, span 15 % of the picture's diagonal both ways and leave no doubt."""
        xy_px = self.corners.xy_px
        spread = np.linalg.svd(xy_px - xy_px.mean(axis=0), compute_uv=False)[1] / np.sqrt(len(xy_px))
        across = 2.0 * spread / np.hypot(camera.width_px, camera.height_px) / _ENOUGH_SPREAD
        exact = 1.0 / (1.0 + (fit.residual_px / _GOOD_RESIDUAL_PX) ** 2)
        certain = 1.0 / (1.0 + (fit.turn_sigma_deg / CERTAIN_DEG) ** 2)
        return float(min(len(xy_px) / _ENOUGH_CORNERS, 1.0) * min(across, 1.0) * exact * certain)
