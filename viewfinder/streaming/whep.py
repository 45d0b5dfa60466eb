"""WHEP (draft-ietf-wish-whep-03): a browser posts an SDP offer and gets the answer; the resource in Location ends with DELETE.

ViewerConnection is one viewer: packets that are encoded already, and beside them what is known of each picture. PacketTrack is the stream
as aiortc sees it, packet by packet; aiortc only cuts them up and sends them. The data channel "status" sends the page a JSON object for
each picture (see `frame_header`) with the RTP timestamp by which `requestVideoFrameCallback` names the picture on the screen, and
{"failure": sentence} when the camera fails; the page may ask {"clock": t} and gets {"clock": t, "server_ms": now} for the age of what it
shows.
"""

import asyncio
import json
import logging
import re
import secrets
import time
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from aiohttp import web
from aiortc import RTCConfiguration, RTCDataChannel, RTCPeerConnection, RTCRtpSender, RTCSessionDescription
from aiortc.mediastreams import MediaStreamError, MediaStreamTrack
from aiortc.sdp import candidate_from_sdp

from mrbokeh.system.errors import InputError
from viewfinder.streaming.encoded_stream import EncodedFrame, EncodedStream, ViewerQueue
from viewfinder.streaming.local_sockets import listen_only_at, served_address
from viewfinder.streaming.session_description import codec_preferences, negotiated_codec, require_offer, with_address

# Where aiortc keeps the RTP timestamp of what it sent last; it is a random number plus our ticks.
_RTP_TIMESTAMP = "_RTCRtpSender__rtp_timestamp"
# The channel that carries a failure may lose it: it is told again so often while it lasts.
_REMIND_S = 1.0


class PacketTrack(MediaStreamTrack):
    """Track that watches the stream from the first `recv` on, which is when the connection stands, so that nobody encodes for nobody.

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
        """Return the next packet, an `av.Packet`. aiortc comes back when it has sent the last one."""
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
    """Wake the loop from the encoder's thread; a loop that closed meanwhile has no viewers any more."""
    try:
        loop.call_soon_threadsafe(news.set)
    except RuntimeError:
        if not loop.is_closed():
            raise


LABEL = "status"
# More in the channel than this means that the network does not carry it: later messages say the same of newer pictures.
_CHANNEL_FULL_BYTES = 32768
_LARGEST_MESSAGE = 1024


class StatusChannel:
    """Channel that says nothing until the page has opened it."""

    def __init__(self) -> None:
        self._channel: RTCDataChannel | None = None

    def open(self, channel: RTCDataChannel, failure: str | None) -> None:
        """Take the page's channel. failure: what the camera suffers from now."""
        self._channel = channel
        channel.on("message", self._answer)
        if failure:
            self.say({"failure": failure})

    def say(self, message: dict[str, Any]) -> None:
        channel = self._channel
        if channel is not None and channel.readyState == "open" and channel.bufferedAmount < _CHANNEL_FULL_BYTES:
            channel.send(json.dumps(message))

    def _answer(self, text: str | bytes) -> None:
        """Answer the clock; a message that is not understood changes nothing."""
        try:
            message = json.loads(text) if len(text) <= _LARGEST_MESSAGE else None
        except (ValueError, RecursionError):
            message = None
        if isinstance(message, dict) and set(message) == {"clock"} and isinstance(message["clock"], int | float):
            self.say({"clock": message["clock"], "server_ms": 1000 * time.monotonic()})
        else:
            self.say({"error": 'expected {"clock": milliseconds}'})


# The method of aiortc's sender that PLI and FIR call; private, so that each release has to be asked whether it is there.
_KEYFRAME_REQUEST = "_send_keyframe"

log = logging.getLogger(__name__)


class ViewerConnection:
    """Peer connection that sends the stream; `on_closed` is called once, when it is over for whatever reason."""

    def __init__(self, stream: EncodedStream, on_closed: Callable[["ViewerConnection"], None]) -> None:
        self._stream, self._on_closed = stream, on_closed
        # No server is asked for our address: that would wait for the internet, and viewers are on this network.
        self.peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self.track = PacketTrack(stream, self._sent, self._failed)
        self._status = StatusChannel()
        self._timer: asyncio.TimerHandle | None = None
        self._closing: asyncio.Task[None] | None = None
        self.codec = ""
        self.peer.on("connectionstatechange", self._state_changed)
        self.peer.on("datachannel", self._channel_opened)

    async def answer(self, offer_sdp: str, connect_within_s: float, host: str | None = None) -> str:
        """Return the SDP answer to a viewer's offer; InputError where it is none that this side can serve.

        host: the one address at which sockets are opened, None opens them on all.
        """
        require_offer(offer_sdp)
        # Both before the offer is looked at: aiortc chooses the codec then, and without preferences it is VP8.
        transceiver = self.peer.addTransceiver(self.track, "sendonly")
        transceiver.setCodecPreferences(codec_preferences())
        self._route_keyframe_requests(transceiver.sender)
        try:
            await self.peer.setRemoteDescription(RTCSessionDescription(offer_sdp, "offer"))
            listen_only_at(self.peer, host)
            await self.peer.setLocalDescription()
        except Exception as error:
            # What aiortc raises at strangers' descriptions has no common class.
            log.debug("an offer was refused", exc_info=True)
            raise InputError(f"expected an SDP offer to receive video in H264 or VP8, got one that cannot be answered ({error})") from None
        answer = self.peer.localDescription.sdp
        self.codec = self.track.codec = negotiated_codec(answer)
        self._timer = asyncio.get_running_loop().call_later(connect_within_s, self._give_up)
        return answer

    async def close(self) -> None:
        """Leave the stream and close the sockets; may be called again."""
        if self._closing is None:
            self._closing = asyncio.ensure_future(self._close())
        await asyncio.shield(self._closing)

    async def _close(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
        self.track.stop()
        try:
            await self.peer.close()
        finally:
            self._on_closed(self)

    def _give_up(self) -> None:
        if self.peer.connectionState != "connected":
            self._begin_closing()

    def _begin_closing(self) -> None:
        if self._closing is None:
            self._closing = asyncio.ensure_future(self._close())

    def _state_changed(self) -> None:
        if self.peer.connectionState in ("failed", "closed"):
            self._begin_closing()

    def _route_keyframe_requests(self, sender: RTCRtpSender) -> None:
        """Route PLI and FIR of this viewer to the encoder of all; aiortc itself would ask the encoder that it does not use."""
        self.track.sender = sender
        if keyframe_requests_arrive():
            setattr(sender, _KEYFRAME_REQUEST, self.track.ask_keyframe)

    def _channel_opened(self, channel: RTCDataChannel) -> None:
        if channel.label == LABEL:
            self._status.open(channel, self._stream.failure)
        else:
            channel.close()

    def _sent(self, frame: EncodedFrame, rtp_timestamp: int | None) -> None:
        self._status.say({"rtp_timestamp": rtp_timestamp, **frame.header})

    def _failed(self, sentence: str | None) -> None:
        if sentence is not None:
            self._status.say({"failure": sentence})


def keyframe_requests_arrive() -> bool:
    """Tell whether this aiortc has the (private) place where PLI and FIR arrive; without it keyframes must come at intervals."""
    return callable(getattr(RTCRtpSender, _KEYFRAME_REQUEST, None))


# Offers of WebRTC list codecs and addresses: those of browsers have 2 to 10 kB.
_LARGEST_SDP = 65536
_CANDIDATE = re.compile(r"^a=candidate:(.+)$", re.MULTILINE)
_MID = re.compile(r"^a=mid:(.+)$", re.MULTILINE)
_MOST_CANDIDATES = 32


class Whep:
    """WHEP of a stream. Who may come is decided before these routes; here only how many (viewers_limit) and how large.

    connect_within_s: a viewer whose connection does not stand by then is removed.
    """

    def __init__(self, stream: EncodedStream, *, viewers_limit: int = 8, connect_within_s: float = 15.0) -> None:
        self._stream, self._viewers_limit, self._connect_within_s = stream, viewers_limit, connect_within_s
        self._viewers: dict[str, ViewerConnection] = {}
        self._closed = False

    def routes(self, path: str = "/whep") -> list[web.RouteDef]:
        return [
            web.post(path, self._offer),
            web.options(path, self._options),
            web.patch(path + "/{viewer}", self._trickle),
            web.delete(path + "/{viewer}", self._leave),
            web.options(path + "/{viewer}", self._options),
        ]

    @property
    def viewers(self) -> int:
        return len(self._viewers)

    async def close(self) -> None:
        """Close all connections; later offers are refused."""
        self._closed = True
        await asyncio.gather(*(viewer.close() for viewer in list(self._viewers.values())))

    async def _offer(self, request: web.Request) -> web.Response:
        if request.content_type != "application/sdp":
            return _refusal(415, f"expected Content-Type application/sdp, got {request.content_type}")
        if self._closed or len(self._viewers) >= self._viewers_limit:
            return _refusal(503, f"expected at most {self._viewers_limit} viewers, and all places are taken: close another page")
        # The place is taken before the first wait, so that many offers at once do not slip through.
        name = secrets.token_urlsafe(16)
        viewer = self._viewers[name] = self._new_viewer(name)
        try:
            async with asyncio.timeout(self._connect_within_s):
                offer = with_address(await _text(request), request.remote)
                answer = await viewer.answer(offer, self._connect_within_s, served_address(request))
        except (InputError, TimeoutError) as error:
            await viewer.close()
            return _refusal(400, str(error) or f"expected an SDP offer within {self._connect_within_s:g} s")
        except BaseException:
            await viewer.close()
            raise
        headers = {"Location": f"{request.path.rstrip('/')}/{name}", "Access-Control-Expose-Headers": "Location"}
        return web.Response(status=201, text=answer, content_type="application/sdp", headers=headers)

    def _new_viewer(self, name: str) -> ViewerConnection:
        if not keyframe_requests_arrive() and self._stream.keyframe_every_s is None:
            self._stream.keyframe_every_s = 2.0
        return ViewerConnection(self._stream, lambda _viewer: self._forget(name))

    def _forget(self, name: str) -> None:
        self._viewers.pop(name, None)

    async def _trickle(self, request: web.Request) -> web.Response:
        """Take further addresses of the viewer (RFC 8840); a restart of ICE is not offered."""
        viewer = self._viewers.get(request.match_info["viewer"])
        if viewer is None:
            return _refusal(404, "there is no such viewer (any more): post a new offer")
        if request.content_type != "application/trickle-ice-sdpfrag":
            return _refusal(415, f"expected Content-Type application/trickle-ice-sdpfrag, got {request.content_type}")
        try:
            await _add_candidates(viewer, with_address(await _text(request), request.remote))
        except InputError as error:
            return _refusal(400, str(error))
        return web.Response(status=204)

    async def _leave(self, request: web.Request) -> web.Response:
        """End a viewer; one whose connection was closed before it could say so has left as well, and is no error on its page."""
        viewer = self._viewers.get(request.match_info["viewer"])
        if viewer is not None:
            await viewer.close()
        return web.Response()

    async def _options(self, _request: web.Request) -> web.Response:
        return web.Response(status=204, headers={"Accept-Post": "application/sdp", "Allow": "POST, PATCH, DELETE, OPTIONS"})


def _refusal(status: int, sentence: str) -> web.Response:
    return web.json_response({"error": sentence}, status=status)


async def _text(request: web.Request) -> str:
    """Read the body; InputError as soon as it is larger than a description can be. The limit of the application does not apply."""
    body = bytearray()
    async for chunk in request.content.iter_any():
        body += chunk
        if len(body) > _LARGEST_SDP:
            raise InputError(f"expected an SDP of at most {_LARGEST_SDP} bytes, got a larger one")
    try:
        return body.decode()
    except UnicodeDecodeError:
        raise InputError("expected an SDP, which is text, got bytes that are not UTF-8") from None


async def _add_candidates(viewer: ViewerConnection, fragment: str) -> None:
    mid = _MID.search(fragment)
    lines = _CANDIDATE.findall(fragment)
    if len(lines) > _MOST_CANDIDATES:
        raise InputError(f"expected at most {_MOST_CANDIDATES} candidates at once, got {len(lines)}")
    for line in lines:
        try:
            candidate = candidate_from_sdp(line.strip())
            candidate.sdpMid = mid.group(1).strip() if mid else "0"
            await viewer.peer.addIceCandidate(candidate)
        except Exception as error:
            raise InputError(f"expected ICE candidates, got {line[:80]!r} ({error})") from None
