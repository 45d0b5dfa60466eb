"""PacketTrack: the stream as aiortc sees it, packet by packet; aiortc only cuts them up and sends them."""

import asyncio
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from aiortc.mediastreams import MediaStreamError, MediaStreamTrack

from viewfinder.streaming.encoded_stream import EncodedStream
from viewfinder.streaming.viewer_queue import EncodedFrame, ViewerQueue

# Where aiortc keeps the RTP timestamp of what it sent last; it is a random number plus our ticks.
_RTP_TIMESTAMP = "_RTCRtpSender__rtp_timestamp"
# The channel that carries a failure may lose it: it is told again so often while it lasts.
_REMIND_S = 1.0


class PacketTrack(MediaStreamTrack):
    """Begins to watch the stream with the first `recv`, which is when the connection stands, so that nobody encodes for nobody.

    sent(frame, rtp_timestamp): called when a packet is on its way, None where this aiortc does not tell the timestamp.
    failed(sentence): the camera failed, again and again while it does; None when it is back. Both in the event loop.
    Set `codec` and `sender` before it is used.
    """

    kind = "video"

    def __init__(
        self, stream: EncodedStream, sent: Callable[[EncodedFrame, int | None], None], failed: Callable[[str | None], None]
    ) -> None:
        super().__init__()
        self._stream, self._sent, self._failed = stream, sent, failed
        self._queue: ViewerQueue | None = None
        self._news = asyncio.Event()
        self._on_its_way: EncodedFrame | None = None
        self._told: str | None = None
        self.codec = ""
        self.sender: Any = None

    async def recv(self) -> Any:
        """The next packet, an `av.Packet`. aiortc comes back when it has sent the last one."""
        if self._on_its_way is not None:
            self._sent(self._on_its_way, getattr(self.sender, _RTP_TIMESTAMP, None))
        self._on_its_way = await self._next()
        return self._on_its_way.packet

    def ask_keyframe(self) -> None:
        if self._queue is not None:
            self._queue.ask_keyframe()

    def stop(self) -> None:
        """Leave the stream; `recv` raises from now on."""
        super().stop()
        if self._queue is not None:
            self._stream.leave(self._queue)
        self._news.set()

    async def _next(self) -> EncodedFrame:
        if self._queue is None and self.readyState == "live":
            loop = asyncio.get_running_loop()
            self._queue = self._stream.watch(self.codec, lambda: _wake(loop, self._news))
        while self._queue is not None and self.readyState == "live":
            # Cleared before looking: what comes after the look sets it again.
            self._news.clear()
            frame = self._queue.take()
            self._tell(self._queue.failure)
            if frame is not None:
                return frame
            await self._woken()
        raise MediaStreamError

    async def _woken(self) -> None:
        with suppress(TimeoutError):
            async with asyncio.timeout(None if self._told is None else _REMIND_S):
                await self._news.wait()

    def _tell(self, failure: str | None) -> None:
        if failure is not None or self._told is not None:
            self._told = failure
            self._failed(failure)


def _wake(loop: asyncio.AbstractEventLoop, news: asyncio.Event) -> None:
    """From the encoder's thread; a loop that closed meanwhile has no viewers any more."""
    try:
        loop.call_soon_threadsafe(news.set)
    except RuntimeError:
        if not loop.is_closed():
            raise
