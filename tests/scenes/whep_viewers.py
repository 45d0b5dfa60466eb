"""What the tests of WHEP share: a server with a stream, and a network that loses and holds packets."""

from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Any

from tests.scenes.streaming_viewers import Viewer, serving
from viewfinder.streaming.encoded_stream import EncodedStream
from viewfinder.streaming.whep import Whep

# Packets that may wait where a test is not about viewers who fall behind: this process may be kept waiting for a second.
PATIENT = 1000
SDP = {"Content-Type": "application/sdp"}


@asynccontextmanager
async def whep_of(stream: EncodedStream, **settings: Any) -> AsyncIterator[tuple[Whep, str]]:
    whep = Whep(stream, **settings)
    async with serving(whep) as url:
        yield whep, url


class Line:
    """What the network does to RTP packets before the viewer sees them: `pass_on(number, packet)` gives those to deliver."""

    def __init__(self, viewer: Viewer, pass_on: Any) -> None:
        receiver = viewer.transceiver.receiver
        deliver, self.number = receiver._handle_rtp_packet, 0

        async def handle(packet: Any, arrival_time_ms: int) -> None:
            self.number += 1
            for each in pass_on(self.number, packet):
                await deliver(each, arrival_time_ms)

        receiver._handle_rtp_packet = handle
