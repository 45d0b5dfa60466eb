"""ViewerQueue: what waits for one viewer between encoder and network, a few packets or nothing until a keyframe; Audience: all viewers."""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import Enum, auto
from threading import Lock
from typing import Any


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
    # Fell behind and has not come back: gets nothing, and nobody makes an effort for it.
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
        """Return a new viewer's queue; who comes while the stream fails is told."""
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
