"""A running viewfinder: its parts put together, and their threads ended with the block."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from jaxtyping import UInt8

from mrbokeh.compositing.overlay import Overlay
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.system.resources import keep_few_arenas
from mrbokeh.tracking.charuco.board import CharucoBoard
from viewfinder.app.assembly import MakeRenderer
from viewfinder.app.focus_choice import blur_of_board, open_focus
from viewfinder.app.live_compositor import LensBook, LiveCompositor, Moment
from viewfinder.app.live_controls import Captures, LiveControls
from viewfinder.app.pipeline import FrameSink, Pipeline
from viewfinder.focus.sources import FocusSource, ManualFocus
from viewfinder.frames import OutputFrame
from viewfinder.server.access import Access
from viewfinder.server.jpeg_stream import JpegStream
from viewfinder.server.site import Part, Site
from viewfinder.sources.frame_source import FrameSource
from viewfinder.stage.overlay_source import Scenery
from viewfinder.stage.stage import Stage
from viewfinder.streaming.alpha_stream import AlphaStream, ObsPart
from viewfinder.streaming.encoded_stream import EncodedStream
from viewfinder.streaming.recording import Recorder
from viewfinder.streaming.virtual_webcam import VirtualWebcam
from viewfinder.streaming.whep import Whep
from viewfinder.tracking.smoothing import SmoothedTracker
from viewfinder.tracking.tracker import Tracker

_MATTE_WIDTH_PX = 320


@dataclass(frozen=True)
class Parts:
    """What a viewfinder is made of. renderers: by name, the scenery begins with the first. captures: folder of bundles and recordings.

    scene: the scene file, whose text bundles keep. smoothing: whether the track is smoothed to begin with. focus_from: names of
    `focus_choice.FOCUS_SOURCES` that are asked first; focus_board: the board whose blur tells the focus. cameras: what else browsers
    send to, by name. webcam: where the pictures go, too.
    """

    source: FrameSource
    scenery: Scenery
    lenses: LensBook
    renderers: Mapping[str, MakeRenderer]
    captures: Path
    tracker: Tracker | None = None
    camera: Camera | None = None
    scene: Path | None = None
    smoothing: bool = False
    access: Access = field(default_factory=Access)
    focus_from: tuple[str, ...] = ()
    focus_board: CharucoBoard | None = None
    cameras: Mapping[str, Part] = field(default_factory=dict)
    webcam: VirtualWebcam | None = None


@dataclass(frozen=True)
class Viewfinder:
    """`site` is what browsers see of it."""

    pipeline: Pipeline
    compositor: LiveCompositor
    site: Site
    webcam: VirtualWebcam | None = None


@contextmanager
def running(parts: Parts) -> Iterator[Viewfinder]:
    """Everything but the server."""
    keep_few_arenas()
    with ExitStack() as closing:
        smoothed = None if parts.tracker is None else SmoothedTracker(parts.tracker, parts.smoothing)
        manual = ManualFocus()
        focus = open_focus(manual, parts.tracker, parts.focus_from, _blur_focus(parts, lambda: compositor.last))
        compositor = LiveCompositor(parts.scenery, parts.source, parts.lenses, focus, smoothed, parts.camera)
        closing.callback(compositor.close)
        jpeg, stream, alone, recorder = JpegStream(), EncodedStream(), EncodedStream(), Recorder(parts.source.transfer)
        alpha = AlphaStream(alone, parts.source.transfer)
        # The stream of the alpha ends after who feeds it.
        for each in (jpeg, stream, alone, alpha, recorder):
            closing.callback(each.close)
        sinks: list[FrameSink] = [jpeg, stream, recorder, OverlaySink(alpha, compositor)]
        if parts.webcam is not None:
            sinks.append(parts.webcam)
            closing.callback(parts.webcam.close)
        pipeline = closing.enter_context(Pipeline(parts.source, compositor, sinks))
        controls = LiveControls(
            compositor,
            manual,
            Captures(parts.captures, compositor, next(iter(parts.renderers)), parts.scene),
            recorder,
            parts.captures,
            parts.renderers,
            lambda: pipeline.failure or pipeline.problem or _remark(parts),
            parts.source.name,
            parts.scenery if isinstance(parts.scenery, Stage) else None,
            smoothed,
        )
        of_site: dict[str, Part] = {"whep": Whep(stream), "obs": ObsPart(Whep(alone))}
        if isinstance(parts.source, Part):
            of_site["whip"] = parts.source
        of_site |= parts.cameras
        site = Site(controls, parts.access, jpeg.room, of_site, lambda: matte_of(compositor))
        yield Viewfinder(pipeline, compositor, site, parts.webcam)


def _remark(parts: Parts) -> str | None:
    """One sentence of the first part that has something to say."""
    of_tracker: str | None = getattr(parts.tracker, "remark", None)
    of_webcam = None if parts.webcam is None else parts.webcam.failure
    return parts.source.status or of_tracker or of_webcam


def _blur_focus(parts: Parts, last: Callable[[], Moment | None]) -> FocusSource | None:
    """last: what the newest picture was made of; its lens has the f-number and the focal length that the page shows."""
    if parts.focus_board is None:
        return None

    def optics() -> tuple[Lens, Camera] | None:
        moment = last()
        return None if moment is None else (moment.lens, moment.camera)

    return blur_of_board(parts.focus_board, parts.lenses.lens, optics)


class OverlaySink:
    """A FrameSink that gives the alpha stream the overlay of each frame."""

    def __init__(self, alpha: AlphaStream, compositor: LiveCompositor) -> None:
        self._alpha, self._compositor = alpha, compositor

    @property
    def wants_frame(self) -> bool:
        return self._alpha.wants_frame

    def show(self, frame: OutputFrame) -> None:
        """Called in the compositing thread, so that `last` is of this frame."""
        if self._compositor.last is not None:
            self._alpha.show(self._compositor.last.overlay, frame)

    def fail(self, sentence: str) -> None:
        self._alpha.fail(sentence)


def matte_of(compositor: LiveCompositor) -> UInt8[np.ndarray, "height width"] | None:
    """Coverage of the virtual layer in the newest frame, at most 320 px wide; None before the first."""
    moment = compositor.last
    return None if moment is None else coverage(moment.overlay, *moment.frame.bgr.shape[1::-1])


def coverage(overlay: Overlay, width_px: int, height_px: int) -> UInt8[np.ndarray, "height width"]:
    import cv2

    matte = np.zeros((height_px, width_px), np.uint8)
    height, width = overlay.shines_through.shape
    there = np.rint(255.0 * np.clip(1.0 - overlay.shines_through, 0.0, 1.0)).astype(np.uint8)
    matte[overlay.top_px : overlay.top_px + height, overlay.left_px : overlay.left_px + width] = there
    scale = min(1.0, _MATTE_WIDTH_PX / width_px)
    return matte if scale == 1.0 else cv2.resize(matte, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
