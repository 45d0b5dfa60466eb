"""One browser camera's connection: a WebRTC peer that only receives."""

import asyncio
import contextlib
import logging
from collections.abc import Callable
from typing import Any

from mrbokeh.system.errors import InputError
from viewfinder.sources.marker_release import release_on_marker

DATA_CHANNEL = "camera"

log = logging.getLogger(__name__)


class WhipSession:
    """Lives in one asyncio loop.

    on_frame: gets every decoded PyAV frame as it comes. on_message: every message of the data channel "camera"; what it returns is
    the answer, None for none. on_end: called once the connection is over.
    """

    def __init__(self, on_frame: Callable[[Any], None], on_message: Callable[[str], str | None], on_end: Callable[[], None]) -> None:
        from aiortc import RTCConfiguration, RTCPeerConnection

        # Without servers of its own aiortc would ask one on the internet and wait for it.
        self._peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self._on_frame, self._on_message, self._on_end = on_frame, on_message, on_end
        self._tasks: set[asyncio.Task[None]] = set()
        self._closed = False
        self.is_vp8 = False
        self._peer.on("track", self._drain_track)
        self._peer.on("datachannel", self._listen)
        self._peer.on("connectionstatechange", self._end_when_over)

    async def answer(self, offer: str) -> str:
        """The SDP that answers an offer, with all candidates in it. Raises InputError for an offer that cannot be answered."""
        from aiortc import RTCSessionDescription
        from aiortc.exceptions import InvalidAccessError, InvalidStateError

        try:
            await self._peer.setRemoteDescription(RTCSessionDescription(offer, "offer"))
            receivers = [each.receiver for each in self._peer.getTransceivers() if each.kind == "video"]
            for receiver in receivers:
                release_on_marker(receiver)
            if not receivers:
                raise InputError("expected an offer with a video track to send, got none")
            await self._peer.setLocalDescription(await self._peer.createAnswer())
        except InputError:
            raise
        except (
            ValueError,
            KeyError,
            IndexError,
            AssertionError,
            AttributeError,
            TypeError,
            InvalidAccessError,
            InvalidStateError,
        ) as error:
            # aiortc's parser checks little and fails in many ways.
            log.debug("an offer was refused", exc_info=True)
            raise InputError(f"expected an SDP offer that WebRTC understands ({type(error).__name__})") from None
        sdp = str(self._peer.localDescription.sdp)
        self.is_vp8 = _first_video_codec(sdp) == "VP8"
        return sdp

    async def close(self) -> None:
        if self._closed:
            return
        self._closed = True
        await self._peer.close()
        for task in self._tasks - {asyncio.current_task()}:
            task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await task
        self._on_end()

    def _start(self, work: Any) -> None:
        task = asyncio.ensure_future(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _drain_track(self, track: Any) -> None:
        self._start(self._drain(track))

    async def _drain(self, track: Any) -> None:
        """Sound too: aiortc queues without bound what nobody takes."""
        from aiortc.mediastreams import MediaStreamError

        with contextlib.suppress(MediaStreamError):
            while True:
                frame = await track.recv()
                if track.kind == "video":
                    self._on_frame(frame)

    def _listen(self, channel: Any) -> None:
        if channel.label == DATA_CHANNEL:

            @channel.on("message")
            def heard(message: str | bytes) -> None:
                answer = self._on_message(message) if isinstance(message, str) else None
                if answer is not None:
                    channel.send(answer)

    def _end_when_over(self) -> None:
        if self._peer.connectionState in ("failed", "closed") and not self._closed:
            self._start(self.close())


def _first_video_codec(sdp: str) -> str | None:
    """The codec that a sender takes: the first of the answer's video."""
    from aiortc.sdp import SessionDescription

    media = next((each for each in SessionDescription.parse(sdp).media if each.kind == "video"), None)
    return media.rtp.codecs[0].name.upper() if media is not None and media.rtp.codecs else None
