"""A small viewfinder for the tests of server and page: controls that remember, and pictures made of what they remember."""

import time
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from threading import Event, Lock, Thread
from typing import Any

import cv2
import numpy as np

from mrbokeh.system.errors import InputError
from viewfinder.frames import FrameStatus, OutputFrame, finite, remark_json
from viewfinder.server.access import Access
from viewfinder.server.controls import VIEWS, State
from viewfinder.server.endpoint import Tls, serving_site
from viewfinder.server.jpeg_stream import JpegStream
from viewfinder.server.site import Site

WIDTH, HEIGHT = 160, 96
# Red, green, blue of the whole picture in each view, and of the square in its middle with each lens.
VIEW_RGB = dict(zip(VIEWS, ((60, 90, 120), (120, 90, 60), (0, 0, 0), (255, 255, 255), (30, 160, 30), (160, 30, 160)), strict=True))
LENS_RGB = {"fifty": (220, 40, 30), "eighty": (30, 60, 220)}
SQUARE = np.s_[32:64, 64:96]


@dataclass
class MadeControls:
    """asked: every call in order, as (method, arguments). A tap in the left half finds 1.5 m, in the right half nothing."""

    asked: list[tuple[Any, ...]] = field(default_factory=list)
    values: dict[str, Any] = field(default_factory=lambda: {"lens": "fifty", "view": "final", "focus": 2.0, "f_number": 2.0})
    visible: bool = True

    def focus_at_distance(self, metres: float) -> None:
        if metres < 0.3:
            raise InputError(f"the lens cannot focus at {metres:g} m: choose 0.3 m or more")
        self._remember("focus", metres)

    def focus_at_point(self, x: float, y: float) -> float:
        self.asked.append(("at", x, y))
        if x > 0.5:
            raise InputError("there is no depth there: tap another place")
        self._remember("focus", 1.5)
        return 1.5

    def set_f_number(self, f_number: float) -> None:
        self._remember("f_number", f_number)

    def set_lens(self, name: str) -> None:
        self._remember("lens", name)

    def set_renderer(self, name: str) -> None:
        self._remember("renderer", name)

    def set_view(self, name: str) -> None:
        self._remember("view", name)

    def move_object(self, name: str, xz_m: tuple[float, float]) -> None:
        self.asked.append(("move", name, *xz_m))

    def show_object(self, name: str, visible: bool) -> None:
        self.asked.append(("show", name, visible))
        self.visible = visible

    def capture(self) -> str:
        self.asked.append(("capture",))
        return "bundle_0001"

    def record(self, on: bool) -> None:
        self._remember("recording", on)

    def smooth(self, on: bool) -> None:
        self._remember("smoothing", on)

    def state(self) -> State:
        return State(
            source="made",
            width_px=WIDTH,
            height_px=HEIGHT,
            dioptre_range=(0.0, 2.0),
            focus_distance_m=finite(self.values["focus"]),
            focus_from=self.values.get("focus_from"),
            f_number=self.values["f_number"],
            f_numbers=[1.4, 2.0, 2.8],
            lens=self.values["lens"],
            lenses=list(LENS_RGB),
            renderer="polygon",
            renderers=["polygon", "scatter"],
            view=self.values["view"],
            views=list(VIEWS),
            objects=[{"name": "lantern", "visible": self.visible}],
            # The picture shows 2 m across and 1.2 m up and down.
            ground_from_picture=[[2.0, 0.0, -1.0], [0.0, 1.2, -0.6], [0.0, 0.0, 1.0]],
            can_capture=True,
            can_record=True,
            recording=self.values.get("recording", False),
            recorded_s=self.values.get("recorded_s"),
            room_s=self.values.get("room_s"),
            notices=self.values.get("notices", []),
            smoothing=self.values.get("smoothing", False),
            failure=None,
            remark=remark_json(self.values.get("remark")),
        )

    def _remember(self, name: str, value: Any) -> None:
        self.asked.append((name, value))
        self.values[name] = value


def made_frame(controls: MadeControls, sequence: int) -> OutputFrame:
    """The colour of the view, in it a square in the colour of the lens with a rim, blurred by a Gaussian of `blur_px`."""
    bgr = np.full((HEIGHT, WIDTH, 3), VIEW_RGB[controls.values["view"]][::-1], np.uint8)
    bgr[28:68, 60:100] = controls.values.get("rim", 255)
    bgr[SQUARE] = LENS_RGB[controls.values["lens"]][::-1]
    if blur_px := controls.values.get("blur_px"):
        bgr = np.asarray(cv2.GaussianBlur(bgr, (0, 0), blur_px), np.uint8)
    status = FrameStatus(
        focus_distance_m=controls.values["focus"],
        f_number=controls.values["f_number"],
        tracking=controls.values.get("tracking", 0.9),
        tracking_unsure=controls.values.get("tracking_unsure", False),
        stages_ms={"composite": 1.25},
        remark=controls.values.get("remark"),
    )
    return OutputFrame(bgr, time.monotonic(), sequence, status)


class Pictures:
    """A thread that shows sinks a new picture every 1/fps seconds while they want one, as the compositing thread does.

    Between `rest` and `go_on` the camera gives nothing.
    """

    def __init__(self, controls: MadeControls, sinks: Sequence[Any], fps: float = 50.0) -> None:
        self._controls, self._sinks, self._period_s = controls, sinks, 1 / fps
        self._stopping, self._resting, self._showing = Event(), Event(), Lock()
        self.shown = 0
        self._thread = Thread(target=self._work, name="made pictures", daemon=True)

    def __enter__(self) -> "Pictures":
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stopping.set()
        self._thread.join()

    def _work(self) -> None:
        sequence = 0
        while not self._stopping.wait(self._period_s):
            with self._showing:
                wanting = [sink for sink in self._sinks if sink.wants_frame]
                if wanting and not self._resting.is_set():
                    frame = made_frame(self._controls, sequence)
                    for sink in wanting:
                        sink.show(frame)
                    self.shown += 1
            sequence += 1

    def rest(self) -> None:
        """Give nothing more; a picture that is under way is shown before this returns."""
        with self._showing:
            self._resting.set()

    def go_on(self) -> None:
        self._resting.clear()


@dataclass
class Made:
    url: str
    controls: MadeControls
    jpeg: JpegStream
    pictures: Pictures
    site: Site


def coverage() -> np.ndarray:
    """The square, which is the virtual thing of the made pictures."""
    matte = np.zeros((HEIGHT, WIDTH), np.uint8)
    matte[SQUARE] = 255
    return matte


@asynccontextmanager
async def made_viewfinder(
    access: Access | None = None, tls: Tls | None = None, host: str = "127.0.0.1", port: int = 0, sinks: Sequence[Any] = (), **parts: Any
) -> AsyncIterator[Made]:
    """A site on loopback with pictures; sinks: get them beside the JPEG stream. parts: of the site, by name."""
    controls, jpeg = MadeControls(), JpegStream()
    site = Site(controls, access=access or Access(), broadcaster=jpeg.broadcaster, matte=coverage, parts=parts)
    try:
        with Pictures(controls, [jpeg, *sinks]) as pictures:
            async with serving_site(site, host, port, tls) as url:
                yield Made(url, controls, jpeg, pictures, site)
    finally:
        jpeg.close()
