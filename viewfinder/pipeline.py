"""Pipeline: camera -> virtual layer over it -> JPEG, in two threads with one slot between; a frame nobody waits for is never made."""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass
from threading import Event, Thread

from mrbokeh.errors import InputError
from mrbokeh.overlay import code_tables
from viewfinder.focused_layer import FocusedLayer
from viewfinder.frames import CameraFrame
from viewfinder.newest import Newest
from viewfinder.sources.frame_source import FrameSource

_POLL_S = 0.1
_LEAVE_S = 3.0

log = logging.getLogger(__name__)


def _ignore(_news: object) -> None:
    """Where nobody listens."""


@dataclass(frozen=True)
class StreamFrame:
    """One finished picture. captured_s: `time.monotonic` of the capture; sequence: the number of the capture."""

    jpeg: bytes
    sequence: int
    captured_s: float
    focus_distance_m: float
    focus_pending: bool
    composite_ms: float
    encode_ms: float


class Pipeline:
    """Runs while open (`with`). `want` asks for one more frame; it comes to `on_frame`, in the compositing thread.

    on_failure gets a sentence if the camera fails, which stays in `failure`; the pipeline then stands still.
    """

    def __init__(self, source: FrameSource, layer: FocusedLayer, jpeg_quality: int = 85) -> None:
        self.source, self.layer, self._jpeg_quality = source, layer, jpeg_quality
        self.on_frame: Callable[[StreamFrame], None] = _ignore
        self.on_failure: Callable[[str], None] = _ignore
        self.failure: str | None = None
        self._tables = code_tables(source.transfer)
        self._newest: Newest[CameraFrame] = Newest()
        self._wanted, self._stopping = Event(), Event()
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
        self.layer.close()

    def want(self) -> None:
        self._wanted.set()

    def _capture(self) -> None:
        try:
            for frame in self.source.frames(self._stopping):
                self._newest.put(frame)
            return
        except InputError as error:
            self.failure = str(error)
        except Exception:
            log.exception("the source failed")
            self.failure = f"{self.source.name} failed; see the terminal"
        self.on_failure(self.failure)

    def _composite(self) -> None:
        while not self._stopping.is_set():
            if not self._wanted.wait(_POLL_S):
                continue
            frame = self._newest.take(_POLL_S)
            if frame is not None:
                # Cleared before the work: who asks during it is served by this frame or asks again on receiving it.
                self._wanted.clear()
                self.on_frame(self._finished(frame))

    def _finished(self, frame: CameraFrame) -> StreamFrame:
        import cv2

        started_s = time.perf_counter()
        shown = self.layer.shown
        bgr = shown.overlay.over_codes(frame.bgr, self._tables)
        composited_s = time.perf_counter()
        jpeg = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, self._jpeg_quality])[1].tobytes()
        encoded_s = time.perf_counter()
        return StreamFrame(
            jpeg,
            frame.sequence,
            frame.captured_s,
            shown.focus_distance_m,
            self.layer.pending,
            composite_ms=1000 * (composited_s - started_s),
            encode_ms=1000 * (encoded_s - composited_s),
        )
