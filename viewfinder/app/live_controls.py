"""LiveControls: what the page may ask for, carried out on the running viewfinder."""

import math
from collections.abc import Callable, Mapping
from pathlib import Path

from mrbokeh.renderers.base import Renderer
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import turned, turned_back
from viewfinder.app.captures import Captures
from viewfinder.app.ground_plane import ground_from_picture
from viewfinder.app.live_compositor import LiveCompositor, Moment
from viewfinder.focus.sources import FirstKnown, ManualFocus
from viewfinder.server.controls import ObjectState, State
from viewfinder.stage.stage import Stage
from viewfinder.streaming.recording import Recorder, recording_path
from viewfinder.tracking.smoothing import SmoothedTracker


class LiveControls:
    """A Controls (viewfinder.server.controls). renderers: by name, made when first chosen.

    stage: None where a finished layer is shown, which has no objects. trouble: a sentence about the camera, or None.
    """

    def __init__(
        self,
        compositor: LiveCompositor,
        manual: ManualFocus,
        captures: Captures,
        recorder: Recorder,
        recordings: Path,
        renderers: Mapping[str, Callable[[], Renderer]],
        trouble: Callable[[], str | None],
        source_name: str,
        stage: Stage | None = None,
        smoothed: SmoothedTracker | None = None,
    ) -> None:
        self._compositor, self._manual, self._captures, self._recorder = compositor, manual, captures, recorder
        self._recordings, self._renderers, self._trouble = recordings, dict(renderers), trouble
        self._source_name, self._stage, self._smoothed = source_name, stage, smoothed

    def focus_at_distance(self, metres: float) -> None:
        closest_m = self._compositor.lenses.closest_m
        if not metres >= closest_m:
            raise InputError(f"this lens focuses from {closest_m:.2f} m on, got {metres:g} m")
        self._manual.focus(metres)

    def focus_at_point(self, x: float, y: float) -> float:
        moment = self._moment()
        height, width = moment.frame.bgr.shape[:2]
        metres = self._compositor.scenery.depth_at_m(min(x * width, width - 0.5), min(y * height, height - 0.5))
        self.focus_at_distance(metres)
        return metres

    def set_f_number(self, f_number: float) -> None:
        self._manual.set_f_number(f_number)

    def set_lens(self, name: str) -> None:
        self._compositor.lenses.choose(name)
        self._manual.set_f_number(None)

    def set_renderer(self, name: str) -> None:
        self._compositor.scenery.set_renderer(name, self._renderers[name]())
        self._captures.renderer_name = name

    def set_view(self, name: str) -> None:
        self._compositor.view = name

    def move_object(self, name: str, xz_m: tuple[float, float]) -> None:
        """By so much on the table, right and away in the upright world."""
        stage = self._staged()
        up = stage.up
        x, y, z = turned(next(each.position_m for each in stage.objects if each.name == name), up)
        stage.move_object(name, turned_back((x + xz_m[0], y, z + xz_m[1]), up))

    def show_object(self, name: str, visible: bool) -> None:
        self._staged().show_object(name, visible)

    def capture(self) -> str:
        return self._captures.capture()

    def record(self, on: bool) -> None:
        if on:
            self._recorder.start(recording_path(self._recordings))
        else:
            self._recorder.stop()

    def smooth(self, on: bool) -> None:
        if self._smoothed is None:
            raise InputError("there is no track to smooth: start the viewfinder with --board, --map or a tracking system")
        self._smoothed.smoothing = on

    def state(self) -> State:
        compositor, moment = self._compositor, self._compositor.last
        lenses, status = compositor.lenses, compositor.scenery.status
        lens = moment.lens if moment else lenses.lens
        height, width = moment.frame.bgr.shape[:2] if moment else (0, 0)
        return State(
            source=self._source_name,
            width_px=width,
            height_px=height,
            dioptre_range=lenses.slider_dioptres,
            focus_distance_m=lens.focus_distance_m if math.isfinite(lens.focus_distance_m) else None,
            focus_from=compositor.focus.focus_from if isinstance(compositor.focus, FirstKnown) else None,
            f_number=lens.f_number,
            f_numbers=lenses.f_numbers,
            lens=lenses.chosen,
            lenses=lenses.names,
            renderer=status.renderer,
            renderers=list(self._renderers),
            view=compositor.view,
            views=list(compositor.scenery.views),
            objects=[] if self._stage is None else [ObjectState(name=each.name, visible=each.visible) for each in self._stage.objects],
            ground_from_picture=self._ground(moment),
            can_capture=True,
            can_record=True,
            recording=self._recorder.wants_frame,
            smoothing=None if self._smoothed is None else self._smoothed.smoothing,
            failure=self._trouble() or status.problem,
        )

    def _ground(self, moment: Moment | None) -> list[list[float]] | None:
        if self._stage is None or moment is None or moment.pose is None:
            return None
        homography = ground_from_picture(moment.camera, self._stage.up)
        return None if homography is None else homography.tolist()

    def _moment(self) -> Moment:
        if self._compositor.last is None:
            raise InputError("the camera has not given a picture yet: wait a moment")
        return self._compositor.last

    def _staged(self) -> Stage:
        if self._stage is None:
            raise InputError("a finished layer has no objects: start the viewfinder with --scene")
        return self._stage
