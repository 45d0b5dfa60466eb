"""Stage: the virtual scene for every frame of the stream, at its newest pose, however long a drawing takes; it fades with the track.

DrawingThread draws the newest request beside the stream, as finely as time allows, and reloads the scene when its files change.
"""

import logging
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Event, Lock, Thread

import numpy as np

from mrbokeh.compositing.over import covered_by
from mrbokeh.compositing.overlay import CodeTables, Overlay
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.scene import SceneRenderer
from mrbokeh.scene.staging.scene_description import PlacedObject, Triple
from mrbokeh.system.errors import InputError
from mrbokeh.tracking.world_axes import upright_camera
from viewfinder.frames import Bgr, Newest, Remark
from viewfinder.stage.drawing import Drawing, DrawRequest, blur_changed, draw, is_outdated, sharp_layers
from viewfinder.stage.overlay_source import StageStatus
from viewfinder.stage.shown_scene import VIEWS, ShownScene, depth_at_m, preparing, reason_unseen, view_picture
from viewfinder.stage.stage_setup import SceneWatch, SetupLoader, StageSetup
from viewfinder.tracking.tracker import TrackedPose

RESOLUTIONS = (1.0, 0.75, 0.5)
LONGEST_S = 1 / 8
_SPARE = 0.8


class AdaptiveResolution:
    """Resolution of the next drawing (`now`). The time of a drawing grows with its pixels."""

    def __init__(self) -> None:
        self.now = 1.0

    def took(self, resolution: float, seconds: float) -> None:
        """Learn that a drawing at this resolution took so long."""
        place = RESOLUTIONS.index(resolution)
        if seconds > LONGEST_S:
            self.now = RESOLUTIONS[min(place + 1, len(RESOLUTIONS) - 1)]
        elif place == 0:
            self.now = resolution
        else:
            finer = RESOLUTIONS[place - 1]
            self.now = finer if seconds * (finer / resolution) ** 2 < _SPARE * LONGEST_S else resolution


_POLL_S = 0.1
_WATCH_S = 0.25
_AFTER_FAILURE_S = 0.25
_RATE_OVER_S = 2.0

log = logging.getLogger(__name__)


@dataclass(frozen=True, eq=False)
class Drawn:
    """Drawing with what it was drawn from; started_s: by `time.monotonic`."""

    drawing: Drawing
    setup: StageSetup
    started_s: float


class DrawingThread:
    """Thread that draws. newest: the last drawing that was finished. Requests that come while one is drawn replace one another.

    problem: a sentence about what keeps the scene file from being read or the scene from being drawn; None if nothing does.
    """

    def __init__(self, loader: SetupLoader) -> None:
        self._loader, self._setup, self._swapping = loader, loader.load(), Lock()
        self._watch = SceneWatch(self._setup.staged.description.files)
        self._asked: Newest[DrawRequest] = Newest()
        self._resolution, self._ends_s = AdaptiveResolution(), deque[float](maxlen=64)
        self._of_file, self._of_drawing = "", ""
        self.newest: Drawn | None = None
        self._busy, self._stopping = Event(), Event()
        self._thread = Thread(target=self._work, name="stage", daemon=True)
        self._thread.start()

    @property
    def setup(self) -> StageSetup:
        return self._setup

    @property
    def busy(self) -> bool:
        return self._busy.is_set()

    @property
    def problem(self) -> str | None:
        waiting = preparing(busy=True) if self.newest is None and self.busy else ""
        return self._of_file or self._of_drawing or waiting or None

    @property
    def draws_per_s(self) -> float:
        """Rate of drawings over the last two seconds."""
        since_s = time.monotonic() - _RATE_OVER_S
        return sum(end_s > since_s for end_s in tuple(self._ends_s)) / _RATE_OVER_S

    def ask(self, request: DrawRequest, finest: bool = False) -> None:
        """Draw this next; at the resolution that there is time for, or finest at every pixel."""
        self._asked.put(replace(request, resolution=1.0 if finest else self._resolution.now))

    def change(self, changed: Callable[[StageSetup], StageSetup]) -> None:
        """Swap the setup for a changed one; what `changed` raises goes to the caller and changes nothing."""
        with self._swapping:
            self._setup = changed(self._setup)

    def close(self) -> None:
        self._stopping.set()
        self._thread.join()

    def _work(self) -> None:
        looked_s = time.monotonic()
        while not self._stopping.is_set():
            request = self._asked.take(_POLL_S)
            if time.monotonic() - looked_s > _WATCH_S:
                self._reload_if_changed()
                looked_s = time.monotonic()
            if request is None or self._is_drawn(request):
                continue
            self._busy.set()
            self._draw(request)
            self._busy.clear()

    def _is_drawn(self, request: DrawRequest) -> bool:
        """Tell whether what was drawn since it was asked for will do: while one view is drawn, every frame asks for it again."""
        newest, setup = self.newest, self._setup
        if newest is None or newest.setup is not setup or newest.drawing.request.resolution < request.resolution:
            return False
        return not is_outdated(newest.drawing, request, setup.staged.is_animated)

    def _draw(self, request: DrawRequest) -> None:
        setup, started_s = self._setup, time.monotonic()
        try:
            drawing = draw(setup.staged, request, setup.render_setup)
        except Exception as error:
            # The stream goes on with the old drawing; another pose, focus or renderer may work.
            if not isinstance(error, InputError):
                log.exception("the scene could not be drawn")
            self._of_drawing = f"the scene could not be drawn: {error}"
            self._stopping.wait(_AFTER_FAILURE_S)
            return
        finished_s = time.monotonic()
        if self.newest is not None and self.newest.setup is setup:
            # The first drawing of a setup loads kernels and prepares the scene: it says nothing about the next.
            self._resolution.took(request.resolution, finished_s - started_s)
        self._of_drawing = ""
        self._ends_s.append(finished_s)
        self.newest = Drawn(drawing, setup, started_s)

    def _reload_if_changed(self) -> None:
        if not self._watch.changed():
            return
        files = self._setup.staged.description.files
        try:
            loaded = self._loader.load(self._setup)
        except InputError as error:
            self._of_file = str(error)
        except Exception:
            log.exception("the scene file could not be loaded")
            self._of_file = f"{self._loader.path} could not be loaded; see the terminal"
        else:
            files, self._of_file = loaded.staged.description.files, ""
            self.change(lambda _: loaded)
        self._watch.follow(files)


FADE_S = 0.5


class Fade:
    """Fade of an object whose track is lost, over half a second. opacity: 0 to 1; a scene that appears begins with 1."""

    def __init__(self) -> None:
        self.opacity = 1.0
        self._last_s: float | None = None

    def at(self, is_tracked: bool, time_s: float) -> float:
        """Return the opacity at a time; times that go back count as no time at all."""
        step = 0.0 if self._last_s is None else max(time_s - self._last_s, 0.0) / FADE_S
        self._last_s = time_s
        self.opacity = min(self.opacity + step, 1.0) if is_tracked else max(self.opacity - step, 0.0)
        return self.opacity


_STILL_S = 0.4
"""After so long without movement a drawing of reduced resolution is drawn again at every pixel."""


class Stage:
    """OverlaySource of a scene file. `overlay` and `picture` belong to the compositing thread; everything else may be called from any."""

    views = VIEWS

    def __init__(self, scene: Path, backend: SceneRenderer | None = None) -> None:
        """Load the scene.

        scene: a scene file (mrbokeh.scene.staging.scene_file); InputError for what is wrong in it.

        backend: None takes the graphics card where there is one, else the ray caster.
        """
        self._thread = DrawingThread(SetupLoader(scene, backend))
        self._fade = Fade()
        self._camera: Camera | None = None
        self._began_s: float | None = None
        self._still_since_s = 0.0
        self._wanted: DrawRequest | None = None
        self.seen: ShownScene | None = None

    @property
    def lens(self) -> Lens | None:
        """Lens that the scene file names."""
        return self._thread.setup.lens

    @property
    def up(self) -> str:
        """Direction of the tracker's world that is up, as the scene file says it."""
        return self._thread.setup.staged.description.up

    @property
    def objects(self) -> tuple[PlacedObject, ...]:
        """Objects as they stand now."""
        return self._thread.setup.staged.description.objects

    def overlay(self, pose: TrackedPose | None, intrinsics: Camera, lens: Lens, time_s: float) -> Overlay:
        """Move the newest drawing to this pose, and ask for a new one where it is too old. Takes about a millisecond.

        pose None: the track is lost; what is shown fades where it was. It fades, too, where a pose is not certain. intrinsics: of this
        frame's size, its pose is not looked at. lens: as it is focused now. time_s: of the frame, `CameraFrame.captured_s`; animations
        and fading go by it.
        """
        is_tracked = pose is not None and pose.is_certain
        opacity = self._fade.at(is_tracked, time_s)
        pose_now = pose.camera_from_world if pose is not None else None if self._camera is None else self._camera.camera_from_world
        if pose_now is None or (self._camera is None and not is_tracked):
            return _nothing()
        self._camera = replace(intrinsics, camera_from_world=pose_now)
        self._began_s = time_s if self._began_s is None else self._began_s
        self._wanted = DrawRequest(self._camera, lens, time_s - self._began_s)
        if pose is not None:
            self._ask_where_outdated(self._wanted)
        return self._shown(self._wanted, opacity)

    def _ask_where_outdated(self, wanted: DrawRequest) -> None:
        drawn, setup = self._thread.newest, self._thread.setup
        if drawn is None or drawn.setup is not setup or is_outdated(drawn.drawing, wanted, setup.staged.is_animated):
            self._still_since_s = wanted.time_s
            self._thread.ask(wanted)
        elif drawn.drawing.request.resolution < 1.0 and wanted.time_s - self._still_since_s > _STILL_S:
            self._still_since_s = wanted.time_s
            self._thread.ask(wanted, finest=True)

    def _shown(self, wanted: DrawRequest, opacity: float) -> Overlay:
        drawn = self._thread.newest
        if drawn is None:
            return _nothing()
        camera = upright_camera(wanted.camera, drawn.setup.staged.description.up)
        layer = drawn.drawing.layer
        overlay = _nothing() if layer is None or opacity == 0.0 else layer.moved_to(camera, opacity)
        self.seen = ShownScene(
            overlay=overlay, camera=camera, drawing=drawn.drawing, staged=drawn.setup.staged, occlusion=drawn.setup.render_setup.occlusion
        )
        return overlay

    @property
    def status(self) -> StageStatus:
        return status_of(self._thread, self._wanted, self._fade.opacity)

    @property
    def remark(self) -> Remark | None:
        wanted, drawn, setup = self._wanted, self._thread.newest, self._thread.setup
        if drawn is None or wanted is None or self.seen is None:
            return Remark(self._thread.problem or preparing(self._thread.busy))
        if self.seen.overlay.rgb.size or drawn.setup is not setup:
            return None
        remark = reason_unseen(setup.staged.description.objects, drawn.drawing.extent_m, self.seen.camera)
        # What the picture shows may be older than the newest drawing, which comes with the next frame.
        is_old = drawn.drawing is not self.seen.drawing or is_outdated(drawn.drawing, wanted, setup.staged.is_animated)
        return None if remark.arrow is None and is_old else remark

    def picture(self, view: str, plate_bgr: Bgr, tables: CodeTables) -> Bgr:
        """Return one of `views`, of the frame for which `overlay` was asked last."""
        return view_picture(view, plate_bgr, self.seen, tables)

    def depth_at_m(self, x_px: float, y_px: float) -> float:
        """Return the depth that a tap there focuses on; InputError where nothing is known."""
        if self.seen is None:
            raise InputError("cannot focus there yet: the scene has not been drawn; wait until the camera is tracked")
        return depth_at_m(self.seen, x_px, y_px)

    def sharp_layers(self, camera: Camera) -> list[Layer]:
        """Draw objects, then their shadow, in focus and at every pixel, as a camera (its pose in the tracker's world) sees them."""
        setup, wanted = self._thread.setup, self._wanted
        frame = upright_camera(camera, setup.staged.description.up)
        layers = sharp_layers(setup.staged, wanted.time_s if wanted else 0.0, frame, setup.render_setup)
        occlusion = setup.render_setup.occlusion
        return layers if occlusion is None else [covered_by(layer, occlusion.matte(layer.depth_m, frame, frame)) for layer in layers]

    def set_renderer(self, name: str, renderer: Renderer) -> None:
        """Blur with another renderer from the next drawing on. name: for the page."""
        self._thread.change(lambda setup: setup.with_renderer(name, renderer))

    def move_object(self, name: str, position_m: Triple) -> None:
        """Stand an object elsewhere, in the tracker's world; until the scene file is written again. InputError for an unknown name."""
        self._thread.change(lambda setup: setup.with_staged(setup.staged.with_object(name, position_m=position_m)))

    def show_object(self, name: str, visible: bool) -> None:
        """Show or hide an object, until the scene file is written again."""
        self._thread.change(lambda setup: setup.with_staged(setup.staged.with_object(name, visible=visible)))

    def close(self) -> None:
        self._thread.close()


def _nothing() -> Overlay:
    return Overlay(0, 0, np.zeros((0, 0, 3), np.float32), np.zeros((0, 0), np.float32))


def status_of(thread: DrawingThread, wanted: DrawRequest | None, opacity: float) -> StageStatus:
    """Return the status. wanted: what was asked for last, None before the first frame."""
    drawn, setup = thread.newest, thread.setup
    return StageStatus(
        layer_age_ms=None if drawn is None else 1e3 * (time.monotonic() - drawn.started_s),
        lens=None if drawn is None else drawn.drawing.request.lens,
        focus_pending=wanted is not None and (drawn is None or _blurred_otherwise(drawn, wanted)),
        draws_per_s=thread.draws_per_s,
        busy=thread.busy,
        resolution=1.0 if drawn is None else drawn.drawing.request.resolution,
        opacity=opacity,
        triangles=sum(each.triangle_count for each in setup.staged.objects),
        renderer=setup.renderer_name,
        problem=thread.problem,
    )


def _blurred_otherwise(drawn: Drawn, wanted: DrawRequest) -> bool:
    return blur_changed(drawn.drawing.request.lens, wanted.lens, drawn.drawing)
