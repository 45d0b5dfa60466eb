"""What the tests of streaming share: pictures, a stream that a thread feeds, a server, viewers over real DTLS and SRTP, a lossy line."""

import asyncio
import json
import time
from collections.abc import AsyncIterator, Callable, Iterable, Iterator
from contextlib import asynccontextmanager, contextmanager
from threading import Event, Thread
from typing import Any

import aiohttp
import numpy as np
from aiohttp import web
from aiortc import RTCConfiguration, RTCPeerConnection, RTCRtpReceiver, RTCSessionDescription

from viewfinder.frames import FrameStatus, OutputFrame
from viewfinder.streaming.encoded_stream import EncodedFrame, EncodedStream, ViewerQueue
from viewfinder.streaming.encoders import StreamQuality
from viewfinder.streaming.whep import Whep

WIDTH, HEIGHT = 320, 180
STATUS = FrameStatus(focus_distance_m=2.0, f_number=2.8, stages_ms={"overlay": 1.5})
# Blue first: black, white, primaries, grey and two mixed colours.
BARS = np.array(
    [[0, 0, 0], [255, 255, 255], [0, 0, 255], [0, 255, 0], [255, 0, 0], [128, 128, 128], [20, 120, 220], [200, 30, 90]], np.uint8
)


def bars(width_px: int = WIDTH, height_px: int = HEIGHT) -> np.ndarray:
    """Eight upright bars of even width (H, W, 3), blue first."""
    return np.ascontiguousarray(np.broadcast_to(BARS[np.arange(width_px) * 8 // width_px][None], (height_px, width_px, 3)))


def bar_centres(bgr: np.ndarray) -> np.ndarray:
    """(8, 3) the colour in the middle of each bar."""
    width = bgr.shape[1]
    return bgr[bgr.shape[0] // 2, width // 16 :: width // 8].astype(int)


def noise(sequence: int) -> np.ndarray:
    return np.random.default_rng(sequence).integers(0, 256, (HEIGHT, WIDTH, 3), np.uint8)


def still(_sequence: int) -> np.ndarray:
    return bars()


def output(bgr: np.ndarray, sequence: int = 0, captured_s: float | None = None) -> OutputFrame:
    return OutputFrame(bgr, time.monotonic() if captured_s is None else captured_s, sequence, STATUS)


class Feed:
    """A compositor in miniature: shows pictures at a rate while the stream wants them, and remembers when each was captured."""

    def __init__(self, stream: EncodedStream, picture: Callable[[int], np.ndarray] = still, fps: float = 60.0) -> None:
        self.captured_s: dict[int, float] = {}
        self._stream, self._picture, self._fps = stream, picture, fps
        self._stopping = Event()
        self._thread = Thread(target=self._run, name="feed", daemon=True)

    def __enter__(self) -> "Feed":
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._stopping.set()
        self._thread.join()

    def _run(self) -> None:
        sequence = 0
        while not self._stopping.wait(1 / self._fps):
            if self._stream.wants_frame:
                frame = output(self._picture(sequence), sequence)
                self.captured_s[sequence] = frame.captured_s
                self._stream.show(frame)
                sequence += 1


@contextmanager
def streaming(quality: StreamQuality | None = None, **settings: Any) -> Iterator[EncodedStream]:
    stream = EncodedStream(quality, **settings)
    try:
        yield stream
    finally:
        stream.close()


@asynccontextmanager
async def serving_routes(routes: Iterable[web.RouteDef], **settings: Any) -> AsyncIterator[str]:
    """The address of a server that has nothing but the routes."""
    app = web.Application(**settings)
    app.add_routes(routes)
    runner = web.AppRunner(app, access_log=None, shutdown_timeout=1.0)
    await runner.setup()
    try:
        await web.TCPSite(runner, "127.0.0.1", 0).start()
        yield f"http://127.0.0.1:{runner.addresses[0][1]}"
    finally:
        await runner.cleanup()


@asynccontextmanager
async def serving(whep: Whep) -> AsyncIterator[str]:
    async with serving_routes(whep.routes(), client_max_size=1024) as url:
        try:
            yield url
        finally:
            await whep.close()


class Viewer:
    """A peer that receives, as the page does: `next` gives decoded pictures (PyAV frames), `messages` what the channel said."""

    def __init__(self, codecs: tuple[str, ...] = ("VP8", "H264")) -> None:
        self.peer = RTCPeerConnection(RTCConfiguration(iceServers=[]))
        self.transceiver = self.peer.addTransceiver("video", "recvonly")
        known = RTCRtpReceiver.getCapabilities("video").codecs
        wanted = [each for name in codecs for each in known if each.mimeType == f"video/{name}"]
        self.transceiver.setCodecPreferences(wanted + [each for each in known if each.mimeType == "video/rtx"])
        self.channel = self.peer.createDataChannel("status", ordered=False, maxRetransmits=0)
        self.messages: list[dict[str, Any]] = []
        self.channel.on("message", lambda text: self.messages.append(json.loads(text)))
        self.location = ""

    async def connect(self, url: str, session: aiohttp.ClientSession) -> None:
        await self.peer.setLocalDescription()
        headers = {"Content-Type": "application/sdp"}
        async with session.post(f"{url}/whep", data=self.peer.localDescription.sdp, headers=headers) as answer:
            assert answer.status == 201, await answer.text()
            self.location = answer.headers["Location"]
            await self.peer.setRemoteDescription(RTCSessionDescription(await answer.text(), "answer"))

    async def next(self) -> Any:
        return await asyncio.wait_for(self.transceiver.receiver.track.recv(), 10)

    async def until(self, true: Callable[[], Any], limit_s: float = 10.0) -> None:
        """Takes pictures until something holds."""
        async with asyncio.timeout(limit_s):
            while not true():
                await self.next()

    def statuses(self) -> list[dict[str, Any]]:
        return [each for each in self.messages if "sequence" in each]


@asynccontextmanager
async def watching(url: str, codecs: tuple[str, ...] = ("VP8", "H264"), viewer: Viewer | None = None) -> AsyncIterator[Viewer]:
    viewer = viewer or Viewer(codecs)
    try:
        async with aiohttp.ClientSession() as session:
            await viewer.connect(url, session)
        yield viewer
    finally:
        await viewer.peer.close()


def ignore() -> None:
    """Ignore the news: nobody has to be woken."""


def taken(viewer: ViewerQueue) -> list[EncodedFrame]:
    """Take all packets that wait for a viewer."""
    frames = []
    while (frame := viewer.take()) is not None:
        frames.append(frame)
    return frames


# Packets that may wait where a test is not about viewers who fall behind: this process may be kept waiting for a second.
PATIENT = 1000
SDP = {"Content-Type": "application/sdp"}


@asynccontextmanager
async def whep_of(stream: EncodedStream, **settings: Any) -> AsyncIterator[tuple[Whep, str]]:
    whep = Whep(stream, **settings)
    async with serving(whep) as url:
        yield whep, url


@contextmanager
def standing_still(connection: Any) -> Iterator[None]:
    """The sender of a viewer waits in the middle of a packet, as it would for a full socket."""
    transport, gate = connection.track.sender.transport, asyncio.Event()
    send = transport._send_rtp

    async def stuck(data: bytes) -> None:
        await gate.wait()
        await send(data)

    transport._send_rtp = stuck
    yield
    gate.set()


class Line:
    """What the network does to RTP packets before the viewer sees them: `pass_on(number, packet)` gives those to deliver."""

    def __init__(self, viewer: Viewer, pass_on: Any) -> None:
        receiver = viewer.transceiver.receiver
        deliver, self.viewer, self.number = receiver._handle_rtp_packet, viewer, 0

        async def handle(packet: Any, arrival_time_ms: int) -> None:
            self.number += 1
            for each in pass_on(self.number, packet):
                await deliver(each, arrival_time_ms)

        receiver._handle_rtp_packet = handle
