"""One viewer over WebRTC: packets that are encoded already, and beside them what is known of each picture.

The page opens a data channel named "status". It gets a JSON object for each picture (see `frame_header`) with the RTP timestamp
by which `requestVideoFrameCallback` names the picture on the screen, and {"failure": sentence} when the camera fails; it may ask
{"clock": t} and gets {"clock": t, "server_ms": now} for the age of what it shows.
"""

import asyncio
import json
import logging
import time
from collections.abc import Callable
from typing import Any

from aiortc import RTCConfiguration, RTCDataChannel, RTCPeerConnection, RTCRtpSender, RTCSessionDescription
from aiortc.sdp import SessionDescription

from mrbokeh.errors import InputError
from viewfinder.streaming.encoded_stream import ENCODERS, EncodedStream
from viewfinder.streaming.packet_track import PacketTrack
from viewfinder.streaming.viewer_queue import EncodedFrame

# More in the channel than this means that the network does not carry it: later messages say the same of newer pictures.
_CHANNEL_FULL_BYTES = 32768
_LARGEST_MESSAGE = 1024
# Browsers offer a picture, sound and a channel; each further section would open sockets here.
_MOST_SECTIONS = 4
# The method of aiortc's sender that PLI and FIR call; private, so that each release has to be asked whether it is there.
_KEYFRAME_REQUEST = "_send_keyframe"

log = logging.getLogger(__name__)


class ViewerConnection:
    """A peer connection that sends the stream; `on_closed` is called once, when it is over for whatever reason."""

    def __init__(self, stream: EncodedStream, on_closed: Callable[["ViewerConnection"], None]) -> None:
        self._stream, self._on_closed = stream, on_closed
        # No server is asked for our address: that would wait for the internet, and viewers are on this network.
        self.peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self.track = PacketTrack(stream, self._sent, self._failed)
        self._channel: RTCDataChannel | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._closing: asyncio.Task[None] | None = None
        self.codec = ""
        self.peer.on("connectionstatechange", self._state_changed)
        self.peer.on("datachannel", self._channel_opened)

    async def answer(self, offer_sdp: str, connect_within_s: float) -> str:
        """The SDP answer to a viewer's offer; InputError where it is none that this side can serve."""
        _require_offer(offer_sdp)
        # Both before the offer is looked at: aiortc chooses the codec then, and without preferences it is VP8.
        transceiver = self.peer.addTransceiver(self.track, "sendonly")
        transceiver.setCodecPreferences(_preferences())
        self._route_keyframe_requests(transceiver.sender)
        try:
            await self.peer.setRemoteDescription(RTCSessionDescription(offer_sdp, "offer"))
            await self.peer.setLocalDescription()
        except Exception as error:
            # What aiortc raises at strangers' descriptions has no common class.
            log.debug("an offer was refused", exc_info=True)
            raise InputError(f"expected an SDP offer to receive video in H264 or VP8, got one that cannot be answered ({error})") from None
        answer = self.peer.localDescription.sdp
        self.codec = self.track.codec = _negotiated_codec(answer)
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
        """PLI and FIR of this viewer to the encoder of all; aiortc itself would ask the encoder that it does not use."""
        self.track.sender = sender
        if keyframe_requests_arrive():
            setattr(sender, _KEYFRAME_REQUEST, self.track.ask_keyframe)

    def _channel_opened(self, channel: RTCDataChannel) -> None:
        if channel.label != "status":
            channel.close()
            return
        self._channel = channel
        channel.on("message", self._answer_message)
        if self._stream.failure:
            self._say({"failure": self._stream.failure})

    def _answer_message(self, text: str | bytes) -> None:
        """A message that is not understood changes nothing."""
        try:
            message = json.loads(text) if len(text) <= _LARGEST_MESSAGE else None
        except (ValueError, RecursionError):
            message = None
        if isinstance(message, dict) and set(message) == {"clock"} and isinstance(message["clock"], int | float):
            self._say({"clock": message["clock"], "server_ms": 1000 * time.monotonic()})
        else:
            self._say({"error": 'expected {"clock": milliseconds}'})

    def _sent(self, frame: EncodedFrame, rtp_timestamp: int | None) -> None:
        self._say({"rtp_timestamp": rtp_timestamp, **frame.header})

    def _failed(self, sentence: str | None) -> None:
        if sentence is not None:
            self._say({"failure": sentence})

    def _say(self, message: dict[str, Any]) -> None:
        channel = self._channel
        if channel is not None and channel.readyState == "open" and channel.bufferedAmount < _CHANNEL_FULL_BYTES:
            channel.send(json.dumps(message))


def keyframe_requests_arrive() -> bool:
    """Whether this aiortc has the (private) place where PLI and FIR arrive; without it keyframes must come at intervals."""
    return callable(getattr(RTCRtpSender, _KEYFRAME_REQUEST, None))


def _require_offer(sdp: str) -> None:
    try:
        media = SessionDescription.parse(sdp).media
    except Exception as error:
        raise InputError(f"expected an SDP offer, got a text that is none ({type(error).__name__}: {error})") from None
    videos = [each for each in media if each.kind == "video"]
    if len(videos) != 1 or videos[0].direction not in ("recvonly", "sendrecv") or len(media) > _MOST_SECTIONS:
        kinds = ", ".join(f"{each.kind} {each.direction or ''}".strip() for each in media) or "nothing"
        raise InputError(f"expected an SDP offer with one video section that receives, got one with {kinds}")
    # aiortc would find this out only when it connects, in a task that nobody listens to.
    if not all(each.dtls and each.dtls.fingerprints and each.ice and each.ice.usernameFragment and each.ice.password for each in media):
        raise InputError("expected an SDP offer with ice-ufrag, ice-pwd and fingerprint, got one that lacks some of them")


def _preferences() -> list[Any]:
    """aiortc's codecs in the order of ENCODERS, and retransmission of each."""
    known = RTCRtpSender.getCapabilities("video").codecs
    ordered = [each for codec in ENCODERS for each in known if each.mimeType == f"video/{codec}"]
    return ordered + [each for each in known if each.mimeType == "video/rtx"]


def _negotiated_codec(answer_sdp: str) -> str:
    """The first codec of the answer's video section, which is what the sender uses."""
    (video,) = (each for each in SessionDescription.parse(answer_sdp).media if each.kind == "video")
    codec = str(video.rtp.codecs[0].name).upper()
    if codec not in ENCODERS:
        raise InputError(f"expected an offer of H264 or VP8, negotiated {codec}")
    return codec
