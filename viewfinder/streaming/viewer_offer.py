"""What a viewer's SDP offer has to be, and which codec comes out of it."""

from typing import Any

from aiortc import RTCRtpSender
from aiortc.sdp import SessionDescription

from mrbokeh.system.errors import InputError
from viewfinder.streaming.encoded_stream import ENCODERS

# Browsers offer a picture, sound and a channel; each further section would open sockets here.
_MOST_SECTIONS = 4


def require_offer(sdp: str) -> None:
    """InputError unless it asks for video, and with all that a connection needs."""
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


def codec_preferences() -> list[Any]:
    """aiortc's codecs in the order of ENCODERS, and retransmission of each."""
    known = RTCRtpSender.getCapabilities("video").codecs
    ordered = [each for codec in ENCODERS for each in known if each.mimeType == f"video/{codec}"]
    return ordered + [each for each in known if each.mimeType == "video/rtx"]


def negotiated_codec(answer_sdp: str) -> str:
    """The first codec of the answer's video section, which is what the sender uses."""
    (video,) = (each for each in SessionDescription.parse(answer_sdp).media if each.kind == "video")
    codec = str(video.rtp.codecs[0].name).upper()
    if codec not in ENCODERS:
        raise InputError(f"expected an offer of H264 or VP8, negotiated {codec}")
    return codec
