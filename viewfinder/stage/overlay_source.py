"""OverlaySource: the protocol of what lies over the camera's picture, and the status that the page shows of it.

StaticLayer is the plainest one: a finished virtual layer before a camera that does not move, blurred again beside the stream when the lens
changes.
"""

import logging
import time
from dataclasses import dataclass
from threading import Event, Thread
from typing import Protocol, runtime_checkable

import numpy as np

from mrbokeh.compositing.overlay import CodeTables, Overlay
from mrbokeh.images.layer import Layer
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.renderers.base import Renderer
from mrbokeh.system.errors import InputError
from viewfinder.frames import Bgr, Newest, Remark
from viewfinder.tracking.tracker import TrackedPose

# A third of the light that the darkest step of 8-bit sRGB needs: weaker traces of a blur cannot be seen in the stream.
_INVISIBLE = 1e-4
_POLL_S = 0.1

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StageStatus:
    """Status that the page shows beside the picture.

    layer_age_ms: since the drawing that is shown was begun, None before the first. lens: that blurred it.

    focus_pending: another blur was asked for and is not shown yet. draws_per_s: over the last two seconds. busy: drawing now.
    resolution: of the drawing, 1 is every pixel. opacity: 0 where the track is lost. problem: a sentence for the page, or None.
    """

    layer_age_ms: float | None
    lens: Lens | None
    focus_pending: bool
    draws_per_s: float
    busy: bool
    resolution: float
    opacity: float
    triangles: int
    renderer: str
    problem: str | None


@runtime_checkable
class OverlaySource(Protocol):
    """Source of what lies over the camera's picture. `overlay` and `picture` belong to the compositing thread. Points: px of the frame.

    views: that `picture` can show.
    """

    views: tuple[str, ...]

    @property
    def status(self) -> StageStatus: ...

    def overlay(self, pose: TrackedPose | None, intrinsics: Camera, lens: Lens, time_s: float) -> Overlay:
        """Return what lies over the frame now; must be fast, the drawing of it happens elsewhere."""
        ...

    @property
    def remark(self) -> Remark | None:
        """Why the overlay that was asked for last, with a certain pose, shows nothing; None where it does, or soon will."""
        ...

    def picture(self, view: str, plate_bgr: Bgr, tables: CodeTables) -> Bgr:
        """Return one of `views`, of the frame for which `overlay` was asked last."""
        ...

    def depth_at_m(self, x_px: float, y_px: float) -> float:
        """Return the depth seen there; InputError where nothing is known."""
        ...

    def sharp_layers(self, camera: Camera) -> list[Layer]:
        """Return everything virtual in focus as a camera (with pose) sees it now, front first; may take its time."""
        ...

    def set_renderer(self, name: str, renderer: Renderer) -> None: ...

    def close(self) -> None: ...


@dataclass(frozen=True)
class Blurred:
    overlay: Overlay
    lens: Lens
    at_s: float


class StaticLayer:
    """OverlaySource of a finished layer. Lenses that come while a blur is under way replace one another, so that the last one wins.

    sharp: the all-in-focus layer, in the size of the frames. `shown` is the newest finished blur. Picture and status are of the blur
    that `overlay` gave last, so that a blur finished while a frame is composited is told of with the next frame.
    """

    views: tuple[str, ...] = ("final", "plate", "virtual")

    def __init__(self, sharp: Layer, lens: Lens, renderer: Renderer, renderer_name: str = "") -> None:
        self.sharp = sharp
        self._renderer, self._renderer_name = renderer, renderer_name
        self._asked_for = (lens, renderer)
        self._wanted: Newest[tuple[Lens, Renderer]] = Newest()
        self._stopping, self._busy = Event(), Event()
        self._problem: str | None = None
        self.shown = self._given = self._blurred(lens, renderer)
        self._worker = Thread(target=self._work, name="static layer", daemon=True)
        self._worker.start()

    @property
    def pending(self) -> bool:
        """Whether a blur was asked for that is not shown yet."""
        return self._busy.is_set() or self._wanted.waiting or self._given is not self.shown

    @property
    def status(self) -> StageStatus:
        given = self._given
        age_ms = 1e3 * (time.monotonic() - given.at_s)
        return StageStatus(
            layer_age_ms=age_ms,
            lens=given.lens,
            focus_pending=self.pending,
            draws_per_s=0.0,
            busy=self._busy.is_set(),
            resolution=1.0,
            opacity=1.0,
            triangles=0,
            renderer=self._renderer_name,
            problem=self._problem,
        )

    def overlay(self, pose: TrackedPose | None, intrinsics: Camera, lens: Lens, time_s: float) -> Overlay:  # noqa: ARG002
        """Return the newest blur; InputError where the frames are not of the layer's size."""
        if (intrinsics.height_px, intrinsics.width_px) != self.sharp.alpha.shape:
            raise InputError(
                f"the layer is {self.sharp.width_px}x{self.sharp.height_px} px, the camera gives {intrinsics.width_px}x"
                f"{intrinsics.height_px} px: render the layer in the camera's size"
            )
        asked_for = (lens, self._renderer)
        if asked_for != self._asked_for:
            self._asked_for = asked_for
            self._wanted.put(asked_for)
        self._given = self.shown
        return self._given.overlay

    @property
    def remark(self) -> Remark | None:
        return None if self._given.overlay.rgb.size else Remark("the layer has nothing in it: every pixel of it is empty")

    def picture(self, view: str, plate_bgr: Bgr, tables: CodeTables) -> Bgr:
        if view == "plate":
            return plate_bgr
        return self._given.overlay.over_codes(plate_bgr if view == "final" else np.zeros_like(plate_bgr), tables)

    def depth_at_m(self, x_px: float, y_px: float) -> float:
        depth_m = float(self.sharp.depth_m[int(y_px), int(x_px)])
        if not np.isfinite(depth_m):
            raise InputError("cannot focus there: only the virtual layer has a depth, and it is not there")
        return depth_m

    def sharp_layers(self, camera: Camera) -> list[Layer]:  # noqa: ARG002
        return [self.sharp]

    def set_renderer(self, name: str, renderer: Renderer) -> None:
        self._renderer, self._renderer_name = renderer, name

    def close(self) -> None:
        self._stopping.set()
        self._worker.join()

    def _work(self) -> None:
        while not self._stopping.is_set():
            wanted = self._wanted.take(_POLL_S)
            if wanted is None:
                continue
            self._busy.set()
            try:
                self.shown, self._problem = self._blurred(*wanted), None
            except Exception as error:
                # The stream goes on with the old blur; a renderer may refuse a focus that another one accepts.
                log.exception("the layer could not be blurred at %s m", wanted[0].focus_distance_m)
                self._problem = f"the layer could not be blurred: {error}"
            finally:
                self._busy.clear()

    def _blurred(self, lens: Lens, renderer: Renderer) -> Blurred:
        blurred = renderer.render([self.sharp], lens)
        return Blurred(Overlay.of(blurred, np.float32(_INVISIBLE).item()), lens, time.monotonic())
