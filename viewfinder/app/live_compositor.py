"""LiveCompositor: one frame of the camera and everything known of it -> one finished picture."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace

from mrbokeh.compositing.overlay import Overlay, code_tables
from mrbokeh.optics.camera import Camera, camera_of_lens
from mrbokeh.optics.lens import Lens
from viewfinder.app.opening import Parts
from viewfinder.focus.sources import FocusSource
from viewfinder.frames import Bgr, CameraFrame, FrameStatus, OutputFrame, Remark
from viewfinder.tracking.tracker import TrackedPose, Tracker


class Stopwatch:
    """Stopwatch of one frame: how long each stage takes, by name."""

    def __init__(self) -> None:
        self.stages_ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        started_s = time.perf_counter()
        yield
        self.stages_ms[name] = 1000.0 * (time.perf_counter() - started_s)


# A board is found a moment after the first picture, and a track that is lost for a picture is not worth a word.
_LATE_S, _UNSEEN_S = 1.0, 0.5
_HINTS = {"board": "show it the board, whole, lit and not too blurred", "map": "show it what the map was made of"}
_NO_POSE = "Nothing tells where the camera is: start with --board, --pose, --map or a tracking system"


class LiveCompositor:
    """Compositor of the compositing thread. view: which of the pictures of the overlay source is streamed.

    tracker: None is a camera that stands where the world begins, unless the source knows its pose.
    last: what the newest picture was made of, for those who ask what lies where. last_tracked: the newest with a certain pose.
    """

    def __init__(self, parts: Parts, focus: FocusSource, tracker: Tracker | None) -> None:
        self.overlays, self.lenses, self.focus, self.tracker = parts.overlays, parts.lenses, focus, tracker
        self._source, self._known_intrinsics = parts.source, parts.intrinsics
        self.view = "final"
        self._seen_s: float | None = None
        self.last: CompositedFrame | None = None
        self.last_tracked: CompositedFrame | None = None

    @property
    def transfer(self) -> str:
        """Curve of the codes of the source's frames."""
        return self._source.transfer

    def __call__(self, frame: CameraFrame, dropped: int) -> OutputFrame:
        watch = Stopwatch()
        intrinsics = self._intrinsics(frame.bgr)
        with watch("track"):
            pose = self._pose(frame, intrinsics)
        with watch("focus"):
            lens = self.lenses.as_set(self.focus.state(frame, pose))
        with watch("warp"):
            overlay = self.overlays.overlay(pose, intrinsics, lens, frame.captured_s)
        with watch("over"):
            bgr = self._picture(frame.bgr, overlay)
        camera = replace(intrinsics, camera_from_world=pose.camera_from_world) if pose else intrinsics
        output = OutputFrame(bgr, frame.captured_s, frame.sequence, self._status(lens, pose, watch, dropped))
        output = replace(output, status=replace(output.status, remark=self._remark(frame, pose, overlay)))
        self.last = CompositedFrame(frame=frame, output=output, overlay=overlay, camera=camera, lens=lens, pose=pose)
        self.last_tracked = self.last if pose is not None and pose.is_certain else self.last_tracked
        return output

    def _intrinsics(self, bgr: Bgr) -> Camera:
        """Return intrinsics for the received size (browsers shrink their pictures when the network is slow)."""
        height, width = bgr.shape[:2]
        if self._known_intrinsics is not None:
            return self._known_intrinsics.resized(width, height)
        return camera_of_lens(self.lenses.lens, width, height)

    def _pose(self, frame: CameraFrame, intrinsics: Camera) -> TrackedPose | None:
        last = self.last
        if last is not None and last.frame is frame and last.pose is not None and last.pose.captured_s == frame.captured_s:
            # Shown again because no newer one came: trackers carry points from one frame to the next, and this is no next one.
            return last.pose
        if self.tracker is not None:
            return self.tracker.track(frame, intrinsics)
        known = frame.camera_from_world
        return TrackedPose(intrinsics.camera_from_world if known is None else known, 1.0, frame.captured_s)

    def _picture(self, plate_bgr: Bgr, overlay: Overlay) -> Bgr:
        tables = code_tables(self.transfer)
        return overlay.over_codes(plate_bgr, tables) if self.view == "final" else self.overlays.picture(self.view, plate_bgr, tables)

    def _status(self, lens: Lens, pose: TrackedPose | None, watch: Stopwatch, dropped: int) -> FrameStatus:
        drawn = self.overlays.status
        shown = drawn.lens or lens
        tracking = None if self.tracker is None else 0.0 if pose is None else pose.quality
        return FrameStatus(
            shown.focus_distance_m,
            shown.f_number,
            focus_pending=drawn.focus_pending,
            tracking=tracking,
            tracking_unsure=pose is not None and not pose.is_certain,
            layer_age_ms=drawn.layer_age_ms or 0.0,
            stages_ms=watch.stages_ms,
            dropped=dropped,
        )

    def _remark(self, frame: CameraFrame, pose: TrackedPose | None, overlay: Overlay) -> Remark | None:
        """Say why the picture is not what the user waits for: it is old, or nothing virtual is in it."""
        age_s = time.monotonic() - frame.captured_s
        if age_s > _LATE_S:
            return Remark(self._source.status or f"{self._source.name} is late: its last picture is {age_s:.0f} s old")
        if overlay.rgb.size or self._seen_s is None:
            self._seen_s = time.monotonic()
        if time.monotonic() - self._seen_s < _UNSEEN_S:
            return None
        if pose is None:
            name = "" if self.tracker is None else self.tracker.name
            return Remark(f"the camera is not tracked: {_HINTS.get(name, f'{name} does not tell where it is')}")
        if not pose.is_certain:
            return Remark("the tilt of the board is unsure: go nearer, or look at it from the side")
        remark = self.overlays.remark
        if remark is None or self.tracker is not None or frame.camera_from_world is not None or remark.arrow is None:
            return remark
        return Remark(f"{remark.sentence}. {_NO_POSE}", remark.arrow)

    def close(self) -> None:
        self.overlays.close()
        self.focus.close()
        if self.tracker is not None:
            self.tracker.close()


@dataclass(frozen=True, eq=False)
class CompositedFrame:
    """Everything one picture was made of. camera: with its pose, identity where the track was lost (pose None)."""

    frame: CameraFrame
    output: OutputFrame
    overlay: Overlay
    camera: Camera
    lens: Lens
    pose: TrackedPose | None
