"""LiveCompositor: one frame of the camera and everything known of it -> one finished picture.

LensBook: the lenses that the page can switch between, and the chosen one as it is set now.
"""

import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, replace

from mrbokeh.compositing.overlay import Overlay, code_tables
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import MM_PER_M, Lens
from mrbokeh.system.errors import InputError
from viewfinder.focus.sources import FocusSource
from viewfinder.frames import Bgr, CameraFrame, FrameStatus, LensState, OutputFrame
from viewfinder.sources.frame_source import FrameSource
from viewfinder.stage.overlay_source import Scenery
from viewfinder.tracking.tracker import TrackedPose, Tracker

F_NUMBERS = (0.95, 1.2, 1.4, 1.8, 2.0, 2.4, 2.8, 4.0, 5.6, 8.0, 11.0, 16.0)
_CLOSEST_FOCAL_LENGTHS = 1.5
_SLIDER_FOCAL_LENGTHS = 6.0


class LensBook:
    """lenses: by name, in the order in which the page shows them. One thread chooses, another asks."""

    def __init__(self, lenses: Mapping[str, Lens]) -> None:
        self._lenses = dict(lenses)
        self.chosen = next(iter(self._lenses))

    @property
    def names(self) -> list[str]:
        return list(self._lenses)

    @property
    def lens(self) -> Lens:
        """The chosen one as its file has it."""
        return self._lenses[self.chosen]

    def choose(self, name: str) -> None:
        if name not in self._lenses:
            raise InputError(f"expected one of the lenses {', '.join(self._lenses)}, got {name!r}")
        self.chosen = name

    @property
    def closest_m(self) -> float:
        """Nearer than this the thin lens of that focal length would need more than three times its extension."""
        return _CLOSEST_FOCAL_LENGTHS * self.lens.focal_length_mm / MM_PER_M

    @property
    def slider_dioptres(self) -> tuple[float, float]:
        """From infinity to a fifth of life size, where lenses that are not for macro end; a tap may go nearer."""
        return 0.0, MM_PER_M / (_SLIDER_FOCAL_LENGTHS * self.lens.focal_length_mm)

    @property
    def f_numbers(self) -> list[float]:
        """What the page offers: the lens's own and the full stops that are smaller openings."""
        return sorted({self.lens.f_number, *(each for each in F_NUMBERS if each > self.lens.f_number)})

    def as_set(self, state: LensState) -> Lens:
        """The chosen lens with what is known of it now; a focus that it cannot reach becomes its closest."""
        lens = self.lens
        focus_m = lens.focus_distance_m if state.focus_distance_m is None else max(state.focus_distance_m, self.closest_m)
        return replace(
            lens,
            focus_distance_m=float(focus_m),
            f_number=state.f_number or lens.f_number,
            focal_length_mm=state.focal_length_mm or lens.focal_length_mm,
        )


class Stopwatch:
    """How long each stage of one frame takes, by name."""

    def __init__(self) -> None:
        self.stages_ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        started_s = time.perf_counter()
        yield
        self.stages_ms[name] = 1000.0 * (time.perf_counter() - started_s)


class LiveCompositor:
    """Called in the compositing thread. view: which of the scenery's pictures is streamed.

    camera: intrinsics of the source in any size; None takes the pinhole of the lens, in the middle of the picture.
    tracker: None is a camera that stands where the world begins, unless the source knows its pose.
    last: what the newest picture was made of, for those who ask what lies where. last_tracked: the newest with a certain pose.
    """

    def __init__(
        self, scenery: Scenery, source: FrameSource, lenses: LensBook, focus: FocusSource, tracker: Tracker | None, camera: Camera | None
    ) -> None:
        self.scenery, self.lenses, self.focus = scenery, lenses, focus
        self._source, self._tracker, self._camera = source, tracker, camera
        self.view = "final"
        self.last: Moment | None = None
        self.last_tracked: Moment | None = None

    @property
    def transfer(self) -> str:
        """The curve of the codes of the source's frames."""
        return self._source.transfer

    def __call__(self, frame: CameraFrame, dropped: int) -> OutputFrame:
        watch = Stopwatch()
        intrinsics = self._intrinsics(frame.bgr)
        with watch("track"):
            pose = self._pose(frame, intrinsics)
        with watch("focus"):
            lens = self.lenses.as_set(self.focus.state(frame, pose))
        with watch("warp"):
            overlay = self.scenery.overlay(pose, intrinsics, lens, frame.captured_s)
        with watch("over"):
            bgr = self._picture(frame.bgr, overlay)
        camera = replace(intrinsics, camera_from_world=pose.camera_from_world) if pose else intrinsics
        output = OutputFrame(bgr, frame.captured_s, frame.sequence, self._status(lens, pose, watch, dropped))
        self.last = Moment(frame, output, overlay, camera, lens, pose)
        self.last_tracked = self.last if pose is not None and pose.is_certain else self.last_tracked
        return output

    def _intrinsics(self, bgr: Bgr) -> Camera:
        """They follow the received size (browsers shrink their pictures when the network is slow)."""
        height, width = bgr.shape[:2]
        if self._camera is not None:
            return self._camera.resized(width, height)
        focal_px = self.lenses.lens.focal_px(width)
        return Camera(width, height, (focal_px, focal_px), (width / 2, height / 2))

    def _pose(self, frame: CameraFrame, intrinsics: Camera) -> TrackedPose | None:
        last = self.last
        if last is not None and last.frame is frame and last.pose is not None and last.pose.captured_s == frame.captured_s:
            # Shown again because no newer one came: trackers carry points from one frame to the next, and this is no next one.
            return last.pose
        if self._tracker is not None:
            return self._tracker.track(frame, intrinsics)
        known = frame.camera_from_world
        return TrackedPose(intrinsics.camera_from_world if known is None else known, 1.0, frame.captured_s)

    def _picture(self, plate_bgr: Bgr, overlay: Overlay) -> Bgr:
        tables = code_tables(self.transfer)
        return overlay.over_codes(plate_bgr, tables) if self.view == "final" else self.scenery.picture(self.view, plate_bgr, tables)

    def _status(self, lens: Lens, pose: TrackedPose | None, watch: Stopwatch, dropped: int) -> FrameStatus:
        drawn = self.scenery.status
        shown = drawn.lens or lens
        tracking = None if self._tracker is None else 0.0 if pose is None else pose.quality
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

    def close(self) -> None:
        self.scenery.close()
        self.focus.close()
        if self._tracker is not None:
            self._tracker.close()


@dataclass(frozen=True, eq=False)
class Moment:
    """What one picture was made of. camera: with its pose, identity where the track was lost (pose None)."""

    frame: CameraFrame
    output: OutputFrame
    overlay: Overlay
    camera: Camera
    lens: Lens
    pose: TrackedPose | None
