"""One viewer over WebRTC: packets that are encoded already, and beside them what is known of each picture."""

import asyncio
import logging
from collections.abc import Callable

from aiortc import RTCConfiguration, RTCDataChannel, RTCPeerConnection, RTCRtpSender, RTCSessionDescription

from mrbokeh.system.errors import InputError
from viewfinder.streaming.encoded_stream import EncodedStream
from viewfinder.streaming.packet_track import PacketTrack
from viewfinder.streaming.status_channel import LABEL, StatusChannel
from viewfinder.streaming.viewer_offer import codec_preferences, negotiated_codec, require_offer
from viewfinder.streaming.viewer_queue import EncodedFrame

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
        self._status = StatusChannel()
        self._timer: asyncio.TimerHandle | None = None
        self._closing: asyncio.Task[None] | None = None
        self.codec = ""
        self.peer.on("connectionstatechange", self._state_changed)
        self.peer.on("datachannel", self._channel_opened)

    async def answer(self, offer_sdp: str, connect_within_s: float) -> str:
        """The SDP answer to a viewer's offer; InputError where it is none that this side can serve."""
        require_offer(offer_sdp)
        # Both before the offer is looked at: aiortc chooses the codec then, and without preferences it is VP8.
        transceiver = self.peer.addTransceiver(self.track, "sendonly")
        transceiver.setCodecPreferences(codec_preferences())
        self._route_keyframe_requests(transceiver.sender)
        try:
            await self.peer.setRemoteDescription(RTCSessionDescription(offer_sdp, "offer"))
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
        """PLI and FIR of this viewer to the encoder of all; aiortc itself would ask the encoder that it does not use."""
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
    """Whether this aiortc has the (private) place where PLI and FIR arrive; without it keyframes must come at intervals."""
    return callable(getattr(RTCRtpSender, _KEYFRAME_REQUEST, None))
