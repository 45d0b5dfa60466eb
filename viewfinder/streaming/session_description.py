"""Session descriptions (SDP) of browsers: what an offer has to be, which codec comes out of it, and addresses hidden behind names.

Browsers that may not use the camera get a made-up name for their address (candidates such as 0500-30d8.local, draft-ietf-mmusic-mdns-
ice-candidates), which only multicast DNS resolves. Many networks and all containers swallow that, and aioice waits a second for it
before it answers. But the offer came from that address.
"""

import ipaddress
import re
from typing import Any

from aiortc import RTCRtpSender
from aiortc.sdp import SessionDescription

from mrbokeh.system.errors import InputError
from viewfinder.streaming.encoders import ENCODERS

_NAMED = re.compile(r"^(a=candidate:(?:\S+ ){4})\S+\.local(?= \d+ typ )", re.MULTILINE | re.IGNORECASE)


def with_address(sdp: str, remote: str | None) -> str:
    """Return the description with `remote`, the address that it came from, in place of all .local names of its candidates.

    It stays as it is where `remote` is no literal IP (as on a socket of the file system) or means something only here (a zone).
    Behind a proxy the address is wrong, as a name that does not resolve is; the viewer then finds us, as ICE allows.
    """
    address = _literal(remote)
    return sdp if address is None else _NAMED.sub(lambda found: found[1] + address, sdp)


def _literal(remote: str | None) -> str | None:
    try:
        address = ipaddress.ip_address(remote or "")
    except ValueError:
        return None
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return str(address.ipv4_mapped)
        if address.scope_id is not None:
            return None
    return str(address)


# Browsers offer a picture, sound and a channel; each further section would open sockets here.
_MOST_SECTIONS = 4


def require_offer(sdp: str) -> None:
    """Raise InputError unless an offer asks for video, and with all that a connection needs."""
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
    """Return aiortc's codecs in the order of ENCODERS, and retransmission of each."""
    known = RTCRtpSender.getCapabilities("video").codecs
    ordered = [each for codec in ENCODERS for each in known if each.mimeType == f"video/{codec}"]
    return ordered + [each for each in known if each.mimeType == "video/rtx"]


def negotiated_codec(answer_sdp: str) -> str:
    """Return the first codec of the answer's video section, which is what the sender uses."""
    (video,) = (each for each in SessionDescription.parse(answer_sdp).media if each.kind == "video")
    codec = str(video.rtp.codecs[0].name).upper()
    if codec not in ENCODERS:
        raise InputError(f"expected an offer of H264 or VP8, negotiated {codec}")
    return codec
