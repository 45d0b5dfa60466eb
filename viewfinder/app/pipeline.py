"""Pipeline: camera -> compositor -> sinks, in two threads with one slot between; a frame that nobody wants is never made."""

import logging
import time
from collections.abc import Callable, Sequence
from threading import Event, Lock, Thread
from typing import Protocol, runtime_checkable

from mrbokeh.system.errors import InputError
from viewfinder.frames import CameraFrame, Newest, OutputFrame
from viewfinder.sources.frame_source import FrameSource

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

    failure: that sentence. problem: a sentence while frames come that cannot be composited.
    """

    def __init__(self, source: FrameSource, compositor: Compositor, sinks: Sequence[FrameSink]) -> None:
        self.source, self._compositor, self._sinks = source, compositor, list(sinks)
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
            if not wanting:
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
