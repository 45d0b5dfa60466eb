"""Running viewfinder, from its options to the address of its page: parts put together, and their threads ended at the end.

Camera -> compositor -> sinks run in two threads with one slot between; a frame that nobody wants is never made.
"""

import asyncio
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from threading import Event, Lock, Thread
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import UInt8

from mrbokeh.compositing.overlay import Overlay
from mrbokeh.optics.camera import Camera
from mrbokeh.optics.lens import Lens
from mrbokeh.system.errors import InputError
from mrbokeh.system.messages import say
from mrbokeh.system.resources import keep_few_arenas
from viewfinder.app.live_compositor import CompositedFrame, LiveCompositor
from viewfinder.app.live_controls import LiveControls, Notices, Takes
from viewfinder.app.opening import Parts, open_parts
from viewfinder.focus.board_focus import BlurOfBoardFocus, FollowingOptics
from viewfinder.focus.sources import FocusSource, ManualFocus, open_focus
from viewfinder.frames import CameraFrame, Newest, OutputFrame
from viewfinder.options import ViewfinderOptions
from viewfinder.server.access import Access
from viewfinder.server.endpoint import Endpoint, on_stop, open_endpoint, serving_site
from viewfinder.server.gallery import Gallery
from viewfinder.server.jpeg_stream import JpegStream
from viewfinder.server.site import Part, Site
from viewfinder.sources.frame_source import FrameSource
from viewfinder.streaming.encoded_stream import EncodedStream
from viewfinder.streaming.other_programs import AlphaStream, ObsPart, VirtualWebcam
from viewfinder.streaming.recording import Recorder
from viewfinder.streaming.take_file import recover_takes
from viewfinder.streaming.whep import Whep
from viewfinder.tracking.smoothing import SmoothedTracker

_POLL_S = 0.01
_REPEAT_S = 0.1  # a camera that stands still is shown again so often, for what lies over it may have changed
_LEAVE_S = 3.0
_IDLE_S = 1.0  # frames are not counted as dropped while nobody watched for so long

log = logging.getLogger(__name__)

Compositor = Callable[[CameraFrame, int], OutputFrame]
"""The finished picture of a frame, and how many frames were dropped so far."""


@runtime_checkable
class FrameSink(Protocol):
    """Receiver of finished pictures. Called in the compositing thread; must return at once (hand over through `Newest`)."""

    @property
    def wants_frame(self) -> bool:
        """Whether a viewer waits, or a recording runs."""
        ...

    def show(self, frame: OutputFrame) -> None: ...

    def fail(self, sentence: str) -> None:
        """Take the news that the source died."""
        ...


class Pipeline:
    """Pipeline that runs while open (`with`). If the camera fails for good, sinks get a sentence, and the pipeline stands still.

    preparing: whether frames are composited though nobody watches yet, so that what is costly once is done before.
    failure: that sentence. problem: a sentence while frames come that cannot be composited.
    """

    def __init__(
        self, source: FrameSource, compositor: Compositor, sinks: Sequence[FrameSink], preparing: Callable[[], bool] = lambda: False
    ) -> None:
        self.source, self._compositor, self._sinks, self._preparing = source, compositor, list(sinks), preparing
        self.failure: str | None = None
        self.problem: str | None = None
        self.dropped = 0
        self._newest: Newest[CameraFrame] = Newest()
        self._stopping = Event()
        # Sinks hear of a dead source after the last picture, which would say that all is well again.
        self._telling = Lock()
        self._threads = [
            Thread(target=work, name=name, daemon=True) for name, work in (("capture", self._capture), ("composite", self._composite))
        ]

    def __enter__(self) -> "Pipeline":
        for thread in self._threads:
            thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stopping.set()
        for thread in self._threads:
            # A camera that hangs in the driver must not keep the program from ending.
            thread.join(_LEAVE_S)

    def _capture(self) -> None:
        try:
            for frame in self.source.frames(self._stopping):
                self._newest.put(frame)
            return
        except InputError as error:
            sentence = str(error)
        except Exception:
            log.exception("the source failed")
            sentence = f"{self.source.name} failed; see the terminal"
        with self._telling:
            self.failure = sentence
            for sink in self._sinks:
                sink.fail(sentence)

    def _composite(self) -> None:
        last: CameraFrame | None = None
        shown_s = 0.0
        while not self._stopping.is_set() and self.failure is None:
            wanting = [sink for sink in self._sinks if sink.wants_frame]
            if not wanting and not self._preparing():
                self._stopping.wait(_POLL_S)
                continue
            frame = self._newest.take(max(0.0, shown_s + _REPEAT_S - time.monotonic()))
            if frame is not None and last is not None and time.monotonic() - shown_s < _IDLE_S:
                self.dropped += max(0, frame.sequence - last.sequence - 1)
            last = last if frame is None else frame
            if last is None:
                self._stopping.wait(_POLL_S)
                continue
            self._finish(last, wanting)
            shown_s = time.monotonic()

    def _finish(self, frame: CameraFrame, wanting: Sequence[FrameSink]) -> None:
        try:
            finished = self._compositor(frame, self.dropped)
        except InputError as error:
            with self._telling:
                if self.failure is None and self.problem != str(error):
                    self.problem = str(error)
                    for sink in self._sinks:
                        sink.fail(self.problem)
            self._stopping.wait(_REPEAT_S)
            return
        except Exception:
            # One bad frame, or a scene that was just being changed, must not end the stream.
            log.exception("a frame could not be composited")
            self._stopping.wait(_REPEAT_S)
            return
        with self._telling:
            if self.failure is None:
                self.problem = None
                for sink in wanting:
                    sink.show(finished)


_MATTE_WIDTH_PX = 320


@dataclass(frozen=True)
class Viewfinder:
    """Running viewfinder. site: what browsers see of it."""

    pipeline: Pipeline
    compositor: LiveCompositor
    site: Site
    webcam: VirtualWebcam | None = None


def serve(options: ViewfinderOptions) -> None:
    """Run until Ctrl-C."""
    try:
        options.refuse_contradictions()
        endpoint = open_endpoint(options.listening)
        with opened(options, endpoint.access) as viewfinder:
            asyncio.run(_served(viewfinder, endpoint))
    except KeyboardInterrupt:
        # While it was starting; everything that was open is closed.
        pass
    say("viewfinder stopped")


async def _served(viewfinder: Viewfinder, endpoint: Endpoint) -> None:
    stopped = asyncio.Event()
    on_stop(stopped.set)
    async with serving_site(viewfinder.site, endpoint.host, endpoint.options.port, endpoint.tls) as url:
        endpoint.announce(f"viewfinder of {viewfinder.pipeline.source.name}", url)
        if viewfinder.webcam is not None:
            say(f"also a webcam for other programs: {viewfinder.webcam.name}")
        if "whip" in viewfinder.site.parts:
            endpoint.announce_camera(url)
        telling = asyncio.create_task(_tell_when_shown(viewfinder.compositor))
        await stopped.wait()
        telling.cancel()


async def _tell_when_shown(compositor: LiveCompositor) -> None:
    """The page says what keeps it; the terminal says when there is something to see."""
    while not is_shown(compositor):
        await asyncio.sleep(_REPEAT_S)
    say("the scene is shown")


@contextmanager
def opened(options: ViewfinderOptions, access: Access) -> Iterator[Viewfinder]:
    """Open all parts and run everything but the server; threads end with the block, or where a part fails."""
    options.refuse_contradictions()
    with ExitStack() as closing, running(open_parts(options, access, closing)) as viewfinder:
        yield viewfinder


@contextmanager
def running(parts: Parts) -> Iterator[Viewfinder]:
    """Run everything but the server; the threads of the parts end with the block."""
    keep_few_arenas()
    with ExitStack() as closing:
        tracker = None if parts.tracker is None else SmoothedTracker(parts.tracker, parts.options.smoothing)
        manual = ManualFocus()
        focus = open_focus(manual, parts.tracker, parts.options.focus_from, _blur_focus(parts, lambda: compositor.last))
        compositor = LiveCompositor(parts, focus, tracker)
        closing.callback(compositor.close)
        notices = Notices()
        for sentence in recover_takes(parts.options.captures):
            notices.say(sentence)
        jpeg, stream, alone, recorder = JpegStream(), EncodedStream(), EncodedStream(), Recorder(lambda: parts.source.transfer, notices.say)
        alpha = AlphaStream(alone, parts.source.transfer)
        # The stream of the alpha ends after who feeds it.
        for each in (jpeg, stream, alone, alpha, recorder):
            closing.callback(each.close)
        sinks: list[FrameSink] = [jpeg, stream, recorder, OverlaySink(alpha, compositor)]
        if parts.webcam is not None:
            sinks.append(parts.webcam)
            closing.callback(parts.webcam.close)
        pipeline = closing.enter_context(Pipeline(parts.source, compositor, sinks, Preparing(compositor)))
        controls = LiveControls(
            parts,
            compositor,
            manual,
            Takes(recorder, notices),
            trouble=lambda: pipeline.failure or pipeline.problem or _remark(parts),
        )
        of_site: dict[str, Part] = {"whep": Whep(stream), "obs": ObsPart(Whep(alone)), "gallery": Gallery(parts.options.captures)}
        if isinstance(parts.source, Part):
            of_site["whip"] = parts.source
        of_site |= parts.cameras
        site = Site(controls=controls, access=parts.access, broadcaster=jpeg.broadcaster, parts=of_site, matte=lambda: matte_of(compositor))
        yield Viewfinder(pipeline, compositor, site, parts.webcam)


_UNASKED_S, _UNASKED_FRAMES = 5.0, 100


class Preparing:
    """Whether frames are composited before anybody watches: until the scene is shown, while it is drawn and for seconds after that.

    What is done once, such as loading kernels, is done then when the page is opened. A camera that is not tracked is not waited for; on a
    busy machine, where seconds are few frames, it has some frames to be tracked in.
    """

    def __init__(self, compositor: LiveCompositor) -> None:
        self._compositor, self._until_s = compositor, time.monotonic() + _UNASKED_S
        self._last, self._frames = compositor.last, 0

    def __call__(self) -> bool:
        if self._compositor.overlays.status.busy:
            self._until_s, self._frames = time.monotonic() + _UNASKED_S, 0
        self._frames += self._compositor.last is not self._last
        self._last = self._compositor.last
        return not is_shown(self._compositor) and (time.monotonic() < self._until_s or self._frames <= _UNASKED_FRAMES)


def is_shown(compositor: LiveCompositor) -> bool:
    """Return whether something virtual lies over the last frame."""
    return compositor.last is not None and compositor.last.overlay.rgb.size > 0


def _remark(parts: Parts) -> str | None:
    """Return one sentence of the first part that has something to say."""
    of_tracker: str | None = getattr(parts.tracker, "remark", None)
    of_webcam = None if parts.webcam is None else parts.webcam.failure
    return parts.source.status or of_tracker or of_webcam


def _blur_focus(parts: Parts, last: Callable[[], CompositedFrame | None]) -> FocusSource | None:
    """Return the focus from the blur of the board, None without one; the newest picture's lens has the f-number that the page shows."""
    if parts.focus_board is None:
        return None

    def optics() -> tuple[Lens, Camera] | None:
        newest = last()
        return None if newest is None else (newest.lens, newest.camera)

    lens = parts.lenses.lens
    nominal = Camera(640, 360, (lens.focal_px(640),) * 2, (320.0, 180.0))
    return FollowingOptics(BlurOfBoardFocus(parts.focus_board, lens, nominal), optics)


class OverlaySink:
    """FrameSink that gives the alpha stream the overlay of each frame."""

    def __init__(self, alpha: AlphaStream, compositor: LiveCompositor) -> None:
        self._alpha, self._compositor = alpha, compositor

    @property
    def wants_frame(self) -> bool:
        return self._alpha.wants_frame

    def show(self, frame: OutputFrame) -> None:
        """Show a frame in the compositing thread, so that `last` is of this frame."""
        if self._compositor.last is not None:
            self._alpha.show(self._compositor.last.overlay, frame)

    def fail(self, sentence: str) -> None:
        self._alpha.fail(sentence)


def matte_of(compositor: LiveCompositor) -> UInt8[np.ndarray, "height width"] | None:
    """Coverage of the virtual layer in the newest frame, at most 320 px wide; None before the first."""
    last = compositor.last
    return None if last is None else coverage(last.overlay, *last.frame.bgr.shape[1::-1])


def coverage(overlay: Overlay, width_px: int, height_px: int) -> UInt8[np.ndarray, "height width"]:
    import cv2

    matte = np.zeros((height_px, width_px), np.uint8)
    height, width = overlay.shines_through.shape
    there = np.rint(255.0 * np.clip(1.0 - overlay.shines_through, 0.0, 1.0)).astype(np.uint8)
    matte[overlay.top_px : overlay.top_px + height, overlay.left_px : overlay.left_px + width] = there
    scale = min(1.0, _MATTE_WIDTH_PX / width_px)
    return matte if scale == 1.0 else cv2.resize(matte, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
