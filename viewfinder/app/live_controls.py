"""LiveControls: what the page may ask for, carried out on the running viewfinder; Captures: moments saved as bundles; Notices."""

import itertools
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import UInt8, UInt16

from mrbokeh.compositing.overlay import code_tables
from mrbokeh.images.color import linear_to_srgb
from mrbokeh.stacks.capture_bundle import write_bundle
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say
from mrbokeh.tracking.world_axes import turned, turned_back
from viewfinder.app.live_compositor import CompositedFrame, LiveCompositor
from viewfinder.app.opening import Parts
from viewfinder.focus.sources import FirstKnown, ManualFocus
from viewfinder.frames import Bgr, CameraFrame, Remark, remark_json, without_folders
from viewfinder.server.controls import Notice, ObjectState, State
from viewfinder.stage.shown_scene import ground_from_picture
from viewfinder.stage.stage import Stage
from viewfinder.streaming.recording import Recorder, recording_path
from viewfinder.tracking.smoothing import SmoothedTracker

_RECENT_S = 0.4  # less than the object takes to fade once the track is lost


class Captures:
    """Bundles of moments that `mrbokeh composite` renders at full quality.

    folder: bundles go there, named by date and time. scene: the file whose text a bundle keeps.
    """

    def __init__(self, folder: Path, compositor: LiveCompositor, renderer_name: str, scene: Path | None = None) -> None:
        self._folder, self._compositor, self.renderer_name, self._scene = folder, compositor, renderer_name, scene

    def capture(self) -> str:
        """Save the newest picture with a pose, if it is recent; return the name of its bundle. InputError where there is none."""
        moment = self._compositor.last_tracked
        if self._compositor.last is None:
            raise InputError("there is nothing to capture yet: the camera has not given a picture")
        if moment is None or self._compositor.last.frame.captured_s - moment.frame.captured_s > _RECENT_S:
            raise InputError("the camera's pose is not known now, so that the object has no place: show the board, then capture")
        name, bgr = self._free_name(), full_picture(moment.frame)
        camera = moment.camera.resized(bgr.shape[1], bgr.shape[0])
        write_bundle(
            self._folder / name,
            plate_png(bgr, self._compositor.transfer),
            _encoded(".jpg", moment.output.bgr),
            self._compositor.overlays.sharp_layers(camera),
            moment.lens,
            camera,
            self.renderer_name,
            self._facts(moment),
        )
        return name

    def _free_name(self) -> str:
        stamp = time.strftime("%Y%m%d-%H%M%S")
        names = (stamp, *(f"{stamp}-{count}" for count in range(2, 1000)))
        return next(name for name in names if not (self._folder / name).exists())

    def _facts(self, moment: CompositedFrame) -> dict[str, Any]:
        status, pose = moment.output.status, moment.pose
        assert pose is not None, "asked before"
        return {
            "captured": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
            "sequence": moment.frame.sequence,
            "tracking": {"quality": pose.quality, "residual_px": pose.residual_px, "points": pose.points},
            "stages_ms": dict(status.stages_ms),
            "scene": None if self._scene is None else self._scene.read_text(encoding="utf-8"),
        }


def full_picture(frame: CameraFrame) -> UInt8[np.ndarray, "full_height full_width 3"]:
    """Return the picture as large as the camera gave it."""
    return frame.bgr if frame.full_picture is None else frame.full_picture()


def plate_png(bgr: Bgr, transfer: str) -> bytes:
    """Encode the camera's picture as an sRGB file: its codes where they are sRGB, else their light in 16 bits.

    A bundle then composites in the same light as the stream did, whatever the camera's curve was.
    """
    if transfer == "srgb":
        return _encoded(".png", bgr)
    table = np.rint(65535.0 * linear_to_srgb(code_tables(transfer).linear_from_code)).astype(np.uint16)
    return _encoded(".png", table[bgr])


def _encoded(suffix: str, bgr: Bgr | UInt16[np.ndarray, "height width 3"]) -> bytes:
    import cv2

    return bytes(cv2.imencode(suffix, bgr)[1].tobytes())


_MOST_NOTICES = 8


class Notices:
    """Notices of what happened by itself, such as a full disk: each goes to the terminal, and the newest to the page."""

    def __init__(self) -> None:
        self.newest: tuple[Notice, ...] = ()
        self._numbers = itertools.count(1)

    def say(self, sentence: str) -> None:
        """Tell everybody; from any thread."""
        say(sentence)
        self.newest = (*self.newest, Notice(number=next(self._numbers), sentence=without_folders(sentence)))[-_MOST_NOTICES:]


@dataclass(frozen=True)
class Takes:
    """Recording of takes, and what is said of them."""

    recorder: Recorder
    notices: Notices


class LiveControls:
    """Controls (viewfinder.server.controls) of a running viewfinder. trouble: a sentence about the camera, or None."""

    def __init__(
        self, parts: Parts, compositor: LiveCompositor, manual: ManualFocus, takes: Takes, trouble: Callable[[], str | None]
    ) -> None:
        self._parts, self._compositor, self._manual, self._takes, self._trouble = parts, compositor, manual, takes, trouble
        self._captures = Captures(parts.options.captures, compositor, next(iter(parts.renderers)), parts.options.scene)
        # A finished layer has no objects.
        self._stage = parts.overlays if isinstance(parts.overlays, Stage) else None
        self._smoothed = compositor.tracker if isinstance(compositor.tracker, SmoothedTracker) else None

    def focus_at_distance(self, metres: float) -> None:
        closest_m = self._compositor.lenses.closest_m
        if not metres >= closest_m:
            raise InputError(f"this lens focuses from {closest_m:.2f} m on, got {metres:g} m")
        self._manual.focus(metres)

    def focus_at_point(self, x: float, y: float) -> float:
        moment = self._moment()
        height, width = moment.frame.bgr.shape[:2]
        metres = self._compositor.overlays.depth_at_m(min(x * width, width - 0.5), min(y * height, height - 0.5))
        self.focus_at_distance(metres)
        return metres

    def set_f_number(self, f_number: float) -> None:
        self._manual.set_f_number(f_number)

    def set_lens(self, name: str) -> None:
        self._compositor.lenses.choose(name)
        self._manual.set_f_number(None)

    def set_renderer(self, name: str) -> None:
        self._compositor.overlays.set_renderer(name, self._parts.renderers[name]())
        self._captures.renderer_name = name

    def set_view(self, name: str) -> None:
        self._compositor.view = name

    def move_object(self, name: str, xz_m: tuple[float, float]) -> None:
        """Move an object on the table, right and away in the upright world."""
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
            self._takes.recorder.start(recording_path(self._parts.options.captures))
        else:
            self._takes.recorder.stop()

    def smooth(self, on: bool) -> None:
        if self._smoothed is None:
            raise InputError("there is no track to smooth: start the viewfinder with --board, --map or a tracking system")
        self._smoothed.smoothing = on

    def state(self) -> State:
        compositor, moment = self._compositor, self._compositor.last
        lenses, status = compositor.lenses, compositor.overlays.status
        lens = moment.lens if moment else lenses.lens
        height, width = moment.frame.bgr.shape[:2] if moment else (0, 0)
        take, failure = self._takes.recorder.take, self._trouble() or status.problem
        return State(
            source=self._parts.source.name,
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
            renderers=list(self._parts.renderers),
            view=compositor.view,
            views=list(compositor.overlays.views),
            objects=[] if self._stage is None else [ObjectState(name=each.name, visible=each.visible) for each in self._stage.objects],
            ground_from_picture=self._ground(moment),
            can_capture=True,
            can_record=True,
            recording=self._takes.recorder.wants_frame,
            recorded_s=None if take is None else take.duration_s,
            room_s=None if take is None else take.room_s,
            notices=list(self._takes.notices.newest),
            smoothing=None if self._smoothed is None else self._smoothed.smoothing,
            failure=None if failure is None else without_folders(failure),
            remark=remark_json(moment.output.status.remark if moment else Remark(f"{self._parts.source.name} has not given a picture yet")),
        )

    def _ground(self, moment: CompositedFrame | None) -> list[list[float]] | None:
        if self._stage is None or moment is None or moment.pose is None:
            return None
        homography = ground_from_picture(moment.camera, self._stage.up)
        return None if homography is None else homography.tolist()

    def _moment(self) -> CompositedFrame:
        if self._compositor.last is None:
            raise InputError("the camera has not given a picture yet: wait a moment")
        return self._compositor.last

    def _staged(self) -> Stage:
        if self._stage is None:
            raise InputError("a finished layer has no objects: start the viewfinder with --scene")
        return self._stage
