"""EncodedStream: finished pictures encoded once for each codec in use, however many watch.

For each of the Audience a ViewerQueue keeps what waits between encoder and network, a few packets or nothing until a keyframe.
"""

import logging
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum, auto
from threading import Event, Lock, Thread
from typing import Any

import numpy as np

from viewfinder.frames import Newest, OutputFrame, frame_header, without_folders
from viewfinder.streaming.encoders import ENCODERS, RtpClock, StreamQuality, VideoEncoder, even_size, i420_frame


@dataclass(frozen=True)
class EncodedFrame:
    """Encoded picture.

    packet: an `av.Packet`, shared by all viewers, not to be changed; its times are in units of `encoder.TIME_BASE`.

    captured_s: of the OutputFrame. header: what the page is told of it (see `frame_header`); stages_ms ends with the encoding.
    """

    packet: Any
    captured_s: float
    header: Mapping[str, Any]

    @property
    def is_keyframe(self) -> bool:
        return bool(self.packet.is_keyframe)


class _State(Enum):
    # Nothing can be shown before a keyframe.
    AWAITING_KEYFRAME = auto()
    FLOWING = auto()
    # Fell behind and has not come back: gets nothing, and nothing is encoded for it.
    STALLED = auto()


class ViewerQueue:
    """Queue filled by the encoder's thread (`put`), emptied by one consumer (`take`); `wake` is called when there is something new.

    A viewer that lets the queue overflow loses all of it: a packet left out spoils all up to the next keyframe. When it comes
    back for more it gets a keyframe.
    """

    def __init__(self, codec: str, capacity: int, wake: Callable[[], None]) -> None:
        self.codec = codec
        self._capacity, self._wake = capacity, wake
        self._frames: deque[EncodedFrame] = deque()
        self._lock = Lock()
        self._state, self._asked = _State.AWAITING_KEYFRAME, False
        self.dropped = 0
        self.failure: str | None = None

    @property
    def waiting(self) -> int:
        """Count of packets that wait to be taken."""
        return len(self._frames)

    @property
    def wants_frames(self) -> bool:
        return self._state is not _State.STALLED

    @property
    def wants_keyframe(self) -> bool:
        with self._lock:
            return self._state is _State.AWAITING_KEYFRAME or (self._asked and self._state is _State.FLOWING)

    def ask_keyframe(self) -> None:
        """Ask for a keyframe: the viewer lost something on the way; packets go on until it comes."""
        with self._lock:
            self._asked = True

    def put(self, frame: EncodedFrame) -> None:
        with self._lock:
            if self._state is _State.STALLED or (self._state is _State.AWAITING_KEYFRAME and not frame.is_keyframe):
                self.dropped += 1
                return
            if len(self._frames) == self._capacity:
                self.dropped += len(self._frames) + 1
                self._frames.clear()
                self._state = _State.STALLED
            else:
                self._frames.append(frame)
                self._state = _State.FLOWING
                self._asked = self._asked and not frame.is_keyframe
        self._wake()

    def take(self) -> EncodedFrame | None:
        """Return the oldest packet, which leaves the queue; None where there is none (yet)."""
        with self._lock:
            if self._frames:
                return self._frames.popleft()
            if self._state is _State.STALLED:
                self._state = _State.AWAITING_KEYFRAME
            return None

    def fail(self, sentence: str | None) -> None:
        """Tell the viewer why there are no more pictures; None: there are again."""
        self.failure = sentence
        self._wake()


class Audience:
    """Viewers of a stream, who come and go in any thread. failure: why there are no pictures; None where there are."""

    def __init__(self, capacity: int) -> None:
        """Begin without viewers. capacity: packets that may wait for one viewer."""
        self._capacity, self._lock = capacity, Lock()
        self.viewers: tuple[ViewerQueue, ...] = ()
        self.failure: str | None = None

    @property
    def wants_frames(self) -> bool:
        return any(viewer.wants_frames for viewer in self.viewers)

    def join(self, codec: str, wake: Callable[[], None]) -> ViewerQueue:
        """Return a new viewer's queue; a viewer who joins while the stream is failing is told so."""
        viewer = ViewerQueue(codec, self._capacity, wake)
        viewer.failure = self.failure
        with self._lock:
            self.viewers = (*self.viewers, viewer)
        return viewer

    def leave(self, viewer: ViewerQueue) -> None:
        with self._lock:
            self.viewers = tuple(each for each in self.viewers if each is not viewer)

    def tell(self, failure: str | None) -> None:
        self.failure = failure
        for viewer in self.viewers:
            viewer.fail(failure)


_POLL_S = 0.1

log = logging.getLogger(__name__)


class EncodedStream:
    """FrameSink with one thread: the newest picture is encoded, older ones that waited are dropped before they cost anything.

    capacity: packets that may wait for one viewer before it counts as fallen behind. keyframe_gap_s: keyframes that viewers ask
    for come at least so far apart. keyframe_every_s: one is made at least so often, for receivers that cannot ask.
    `encoded` counts packets by codec, `keyframes` those that stand alone; `encode_ms` is that of the last frame.
    """

    def __init__(
        self,
        quality: StreamQuality | None = None,
        *,
        capacity: int = 8,
        keyframe_gap_s: float = 0.5,
        keyframe_every_s: float | None = None,
    ) -> None:
        self._quality, self._audience = quality or StreamQuality(), Audience(capacity)
        self._keyframe_gap_s, self.keyframe_every_s = keyframe_gap_s, keyframe_every_s
        self._newest: Newest[OutputFrame] = Newest()
        self._stopping = Event()
        self._encoders: dict[str, VideoEncoder] = {}
        self._keyframe_s: dict[str, float] = {}
        self._clock = RtpClock()
        self.encoded: Counter[str] = Counter()
        self.keyframes: Counter[str] = Counter()
        self.encode_ms = 0.0
        self._thread = Thread(target=self._work, name="encode", daemon=True)
        self._thread.start()

    @property
    def wants_frame(self) -> bool:
        return self._audience.wants_frames

    @property
    def viewers(self) -> tuple[ViewerQueue, ...]:
        return self._audience.viewers

    @property
    def failure(self) -> str | None:
        """Reason why there are no pictures; None where there are."""
        return self._audience.failure

    def show(self, frame: OutputFrame) -> None:
        if self.failure is not None:
            self._audience.tell(None)
        self._newest.put(frame)

    def fail(self, sentence: str) -> None:
        self._audience.tell(without_folders(sentence))

    def watch(self, codec: str, wake: Callable[[], None]) -> ViewerQueue:
        """Return a new viewer's queue, which begins with a keyframe. codec: of ENCODERS. wake: called in the encoder's thread."""
        if codec not in ENCODERS:
            raise ValueError(f"expected a codec of {list(ENCODERS)}, got {codec!r}")
        return self._audience.join(codec, wake)

    def leave(self, viewer: ViewerQueue) -> None:
        self._audience.leave(viewer)

    def close(self) -> None:
        """End the thread; viewers get nothing more."""
        self._stopping.set()
        self._thread.join()

    def _work(self) -> None:
        # The compiled conversion is loaded before the first viewer waits for it.
        i420_frame(np.zeros((2, 2, 3), np.uint8))
        while not self._stopping.is_set():
            frame = self._newest.take(_POLL_S)
            viewers = self.viewers
            self._close_encoders(set(self._encoders) - {viewer.codec for viewer in viewers})
            if frame is None:
                continue
            try:
                self._encode_for(frame, viewers)
            except Exception:
                # A new encoder may succeed with the next picture; the stream must not end with one.
                log.exception("a picture of %sx%s px could not be encoded", frame.bgr.shape[1], frame.bgr.shape[0])
                self._close_encoders(set(self._encoders))
        self._close_encoders(set(self._encoders))

    def _encode_for(self, frame: OutputFrame, viewers: tuple[ViewerQueue, ...]) -> None:
        codecs = dict.fromkeys(viewer.codec for viewer in viewers if viewer.wants_frames)
        if not codecs:
            return
        started_s = time.perf_counter()
        picture = i420_frame(frame.bgr)
        converted_ms = 1000 * (time.perf_counter() - started_s)
        ticks = self._clock.ticks(frame.captured_s)
        for codec in codecs:
            listeners = [viewer for viewer in viewers if viewer.codec == codec]
            encoder = self._encoder(codec, even_size(frame.bgr))
            if self._keyframe_due(codec, listeners):
                encoder.force_keyframe()
            packet = encoder.encode(picture, ticks)
            self.encode_ms = converted_ms + encoder.encode_ms
            self._count(codec, packet)
            encoded = EncodedFrame(packet, frame.captured_s, self._header(frame, codec))
            for viewer in listeners:
                viewer.put(encoded)

    def _header(self, frame: OutputFrame, codec: str) -> dict[str, Any]:
        header = frame_header(frame)
        header["stages_ms"][codec.lower()] = round(self.encode_ms, 2)
        return header

    def _encoder(self, codec: str, size_px: tuple[int, int]) -> VideoEncoder:
        """Return the encoder in use, or a new one where the size changed; a new one begins with a keyframe."""
        if codec in self._encoders and self._encoders[codec].size_px != size_px:
            self._close_encoders({codec})
        if codec not in self._encoders:
            self._encoders[codec] = ENCODERS[codec](*size_px, self._quality)
        return self._encoders[codec]

    def _close_encoders(self, codecs: set[str]) -> None:
        for codec in codecs:
            self._encoders.pop(codec).close()

    def _keyframe_due(self, codec: str, listeners: list[ViewerQueue]) -> bool:
        since_s = time.monotonic() - self._keyframe_s.get(codec, -1e9)
        if self.keyframe_every_s is not None and since_s >= self.keyframe_every_s:
            return True
        return since_s >= self._keyframe_gap_s and any(viewer.wants_keyframe for viewer in listeners)

    def _count(self, codec: str, packet: Any) -> None:
        self.encoded[codec] += 1
        if packet.is_keyframe:
            self.keyframes[codec] += 1
            self._keyframe_s[codec] = time.monotonic()
