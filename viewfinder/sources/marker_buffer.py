"""Video frames from aiortc without its wait for the next frame, and never torn ones.

aiortc's JitterBuffer gives a frame away when the first packet of the next one comes: one frame of delay. RTP sets the marker bit in
the last packet of a picture (RFC 6184, 5.1; RFC 7741, 4.1), so that the frame can go when all packets up to that one are there. This
leans on parts of aiortc that are not public: `works` tries them first, and where they are others than known the stock buffer stays.
"""

import logging
import queue
import time
from collections.abc import Callable
from functools import cache
from typing import Any

from aiortc.jitterbuffer import JitterBuffer, JitterFrame
from aiortc.utils import uint16_add

# How long packets wait for a missing one, which a sender on the same network repeats within some 20 ms.
PATIENCE_S = 0.25
_H264_SEQUENCE_PARAMETERS, _VP8_START_CODE = 7, b"\x9d\x01\x2a"


class MarkerFrame(JitterFrame):
    """Frame with its last packet. followers: frames that became whole at the same moment, in order. sent_timestamp: that of RTP."""

    def __init__(self, data: bytes, timestamp: int) -> None:
        super().__init__(data=data, timestamp=timestamp)
        self.sent_timestamp = timestamp
        self.followers: list[MarkerFrame] = []


class MarkerJitterBuffer(JitterBuffer):
    """JitterBuffer that gives a frame away with its last packet; a torn frame is dropped, and a key frame asked for.

    Stock gives away what is left of such a frame, and waits for a missing packet until the buffer is full. now_s: the clock.
    """

    def __init__(self, capacity: int, now_s: Callable[[], float] = time.monotonic) -> None:
        super().__init__(capacity, is_video=True)
        # Sequence numbers whose packet had the marker, at their number modulo the capacity; and where a frame is known to start.
        self._marked: list[int | None] = [None] * capacity
        self._start: int | None = None
        self._torn = False
        self._now_s, self._held_since_s = now_s, None

    _held_since_s: float | None
    _origin: Any
    _packets: list[Any]

    def add(self, packet: Any) -> tuple[bool, Any]:
        """Return (whether a key frame is to be asked for, the frames that are whole now as a MarkerFrame, or None)."""
        if packet.marker:
            self._marked[packet.sequence_number % self._capacity] = packet.sequence_number
        self._torn = False
        lost, frame = super().add(packet)
        return lost or self._torn, frame

    def _remove_frame(self, sequence_number: int) -> Any:
        frames = self._whole_frames()
        if not frames and self._held_too_long(sequence_number):
            self._torn = True
            self.smart_remove(len(self._run()) + 1)
            frames = self._whole_frames()
        if not frames:
            return None
        self._held_since_s = None
        frames[0].followers = frames[1:]
        return frames[0]

    def _held_too_long(self, sequence_number: int) -> bool:
        """Whether the packet that came lies behind a gap, as others have for a while."""
        if uint16_add(sequence_number, -self._origin) < len(self._run()):
            self._held_since_s = None
            return False
        if self._held_since_s is None:
            self._held_since_s = self._now_s()
        return self._now_s() - self._held_since_s > PATIENCE_S

    def _whole_frames(self) -> list[MarkerFrame]:
        """Take all whole frames at the origin out of the buffer, and what is left of torn ones."""
        frames: list[MarkerFrame] = []
        for _ in range(self._capacity):
            packets = self._first_frame()
            if not packets:
                break
            started = self._starts_here(packets[0])
            data = b"".join(each._data for each in packets)
            self.remove(len(packets))
            self._start = self._origin
            if started and data:
                frames.append(MarkerFrame(data, packets[0].timestamp))
            # Padding has no data, and an empty packet would end the decoder's work for good.
            self._torn = self._torn or bool(data and not started)
        return frames

    def _first_frame(self) -> list[Any]:
        """Packets from the origin to the end of their frame; empty while one is missing."""
        packets: list[Any] = []
        for packet in self._run():
            if packets and packet.timestamp != packets[0].timestamp:
                return packets
            packets.append(packet)
            if packet.marker:
                return packets
        return []

    def _run(self) -> list[Any]:
        """Return the packets from the origin up to the first that is missing."""
        run: list[Any] = []
        for count in range(self._capacity):
            packet = self._packets[(self._origin + count) % self._capacity]
            if packet is None:
                break
            run.append(packet)
        return run

    def _starts_here(self, packet: Any) -> bool:
        """Whether a frame is known to begin with this packet: after the end of one, or by the head of a key frame."""
        number, before = packet.sequence_number, uint16_add(packet.sequence_number, -1)
        return number == self._start or self._marked[before % self._capacity] == before or is_key_start(packet._data)


def is_key_start(data: bytes) -> bool:
    """Tell whether data begin with H264's sequence parameters or the header of a VP8 key frame (RFC 6386, 9.1)."""
    if data[:4] == b"\0\0\0\1":
        return len(data) > 4 and data[4] & 0x1F == _H264_SEQUENCE_PARAMETERS
    return len(data) > 5 and not data[0] & 1 and data[3:6] == _VP8_START_CODE


_BUFFER, _QUEUE, _THREAD = (f"_RTCRtpReceiver__{name}" for name in ("jitter_buffer", "decoder_queue", "decoder_thread"))

log = logging.getLogger(__name__)


def release_on_marker(receiver: Any) -> bool:
    """Give a video receiver, through which nothing came yet, the other buffer; False where aiortc is another than expected."""
    stock: Any = getattr(receiver, _BUFFER, None)
    known = type(stock).__name__ == "JitterBuffer" and getattr(stock, "_origin", 0) is None
    known = known and type(getattr(receiver, _QUEUE, None)) is queue.Queue and getattr(receiver, _THREAD, 0) is None
    if not known or not works():
        log.info("aiortc's jitter buffer is not the one that is known: each frame waits for the next one")
        return False

    setattr(receiver, _BUFFER, MarkerJitterBuffer(stock.capacity))
    setattr(receiver, _QUEUE, BurstQueue())
    return True


class BurstQueue(queue.Queue[Any]):
    """Queue of a receiver's decoder: takes (codec, frame) and puts the frame's followers in behind it.

    A receiver asks its buffer for one frame per packet and maps that one's timestamp; the followers get the same shift.
    """

    def put(self, item: Any, block: bool = True, timeout: float | None = None) -> None:
        super().put(item, block, timeout)
        if item is None:
            return
        codec, frame = item
        for follower in getattr(frame, "followers", ()):
            follower.timestamp = frame.timestamp + (follower.timestamp - frame.sent_timestamp) % (1 << 32)
            super().put((codec, follower), block, timeout)


@cache
def works() -> bool:
    """Try the buffer on the installed aiortc: frames of two packets, one in the wrong order; then one that held up two others."""
    try:
        from aiortc.rtp import RtpPacket

        trial, given = MarkerJitterBuffer(16), []
        key = b"\0\0\0\1\x67"
        packets = [
            (65534, 1, 0, key),
            (65535, 1, 1, b"b"),
            (1, 2, 1, b"d"),
            (0, 2, 0, b"c"),
            (3, 4, 1, b"f"),
            (4, 5, 1, b"g"),
            (2, 3, 1, b"e"),
        ]
        for number, timestamp, marker, data in packets:
            packet: Any = RtpPacket(sequence_number=number, timestamp=timestamp, marker=marker)
            packet._data = data
            frame = trial.add(packet)[1]
            given.append([(each.timestamp, each.data) for each in (frame, *frame.followers)] if frame else [])
        return given == [[], [(1, key + b"b")], [], [(2, b"cd")], [], [], [(3, b"e"), (4, b"f"), (5, b"g")]]
    except Exception:
        log.debug("the jitter buffer with marker release does not work on this aiortc", exc_info=True)
        return False
