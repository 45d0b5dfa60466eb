"""Stage: the virtual scene for every frame of the stream, at its newest pose, however long a drawing takes; it fades with the track."""

import time
from dataclasses import replace
from pathlib import Path

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
from viewfinder.frames import Bgr
from viewfinder.stage.drawing import DrawRequest, blur_changed, is_outdated, sharp_layers
from viewfinder.stage.drawing_thread import DrawingThread, Drawn
from viewfinder.stage.overlay_source import StageStatus
from viewfinder.stage.shown_scene import VIEWS, ShownScene, depth_at_m, view_picture
from viewfinder.stage.stage_setup import SetupLoader
from viewfinder.tracking.tracker import TrackedPose

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
