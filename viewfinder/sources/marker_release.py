"""Video frames from aiortc without its wait for the next frame, and never torn ones.

aiortc's JitterBuffer gives a frame away when the first packet of the next one comes: one frame of delay. RTP sets the marker bit in
the last packet of a picture (RFC 6184, 5.1; RFC 7741, 4.1), so that the frame can go when all packets up to that one are there
(viewfinder.sources.marker_buffer). This leans on parts of aiortc that are not public: they are tried first, and where they are
others than known the stock buffer stays.
"""

import logging
import queue
from functools import cache
from typing import Any

_BUFFER, _QUEUE, _THREAD = (f"_RTCRtpReceiver__{name}" for name in ("jitter_buffer", "decoder_queue", "decoder_thread"))

log = logging.getLogger(__name__)


def release_on_marker(receiver: Any) -> bool:
    """Give an RTCRtpReceiver of video, through which nothing came yet, the other buffer; False where aiortc is another than expected."""
    stock: Any = getattr(receiver, _BUFFER, None)
    known = type(stock).__name__ == "JitterBuffer" and getattr(stock, "_origin", 0) is None
    known = known and type(getattr(receiver, _QUEUE, None)) is queue.Queue and getattr(receiver, _THREAD, 0) is None
    if not known or not works():
        log.info("aiortc's jitter buffer is not the one that is known: each frame waits for the next one")
        return False
    from viewfinder.sources.marker_buffer import MarkerJitterBuffer

    setattr(receiver, _BUFFER, MarkerJitterBuffer(stock.capacity))
    setattr(receiver, _QUEUE, BurstQueue())
    return True


class BurstQueue(queue.Queue[Any]):
    """The queue of a receiver's decoder: takes (codec, frame) and puts the frame's followers in behind it.

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
    """Tried out on the installed aiortc: frames of two packets, one of them in the wrong order; then one that held up two others."""
    try:
        from aiortc.rtp import RtpPacket

        from viewfinder.sources.marker_buffer import MarkerJitterBuffer

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
