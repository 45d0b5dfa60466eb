"""A browser camera as aiortc plays it: a canvas of one colour, and the WHIP client that sends it."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from fractions import Fraction
from typing import Any

import aiohttp
import aiortc
import av
import numpy as np

WIDTH, HEIGHT, FPS = 160, 112, 20


class Canvas(aiortc.VideoStreamTrack):
    """One colour (blue, green, red) in a size that can be changed while it runs, as browsers do."""

    def __init__(self, bgr: tuple[int, int, int]) -> None:
        super().__init__()
        self.bgr, self.size_px, self.noise, self._count = bgr, (WIDTH, HEIGHT), 0, 0

    async def recv(self) -> av.VideoFrame:
        await asyncio.sleep(1 / FPS)
        width_px, height_px = self.size_px
        picture = np.full((height_px, width_px, 3), self.bgr, np.uint8)
        if self.noise:
            # So that a frame takes several packets.
            picture += np.random.default_rng(self._count).integers(0, self.noise, picture.shape, np.uint8) // 2
        frame = av.VideoFrame.from_ndarray(picture, "bgr24")
        # What WebRTC codecs take: limited range, BT.601.
        frame = frame.reformat(format="yuv420p", dst_colorspace=5, dst_color_range=1)
        self._count += 1
        frame.pts, frame.time_base = self._count * 90000 // FPS, Fraction(1, 90000)
        return frame


class Sender:
    """A WHIP client: `location` is where it ends."""

    def __init__(self, url: str, track: Canvas, codec: str = "video/VP8") -> None:
        self.url, self.track, self.answers = url, track, list[dict[str, Any]]()
        self.peer = aiortc.RTCPeerConnection(aiortc.RTCConfiguration(iceServers=[]))
        self.channel = self.peer.createDataChannel("camera")
        self.channel.on("message", lambda text: self.answers.append(json.loads(text)))
        transceiver = self.peer.addTransceiver(track, direction="sendonly")
        codecs = aiortc.RTCRtpSender.getCapabilities("video").codecs
        transceiver.setCodecPreferences([each for each in codecs if each.mimeType == codec])
        self.location = ""

    async def start(self, session: aiohttp.ClientSession) -> None:
        await self.peer.setLocalDescription(await self.peer.createOffer())
        headers = {"Content-Type": "application/sdp"}
        async with session.post(self.url + "/whip", data=self.peer.localDescription.sdp.encode(), headers=headers) as answer:
            text = await answer.text()
            assert answer.status == 201, text
            assert answer.content_type == "application/sdp"
            self.location = answer.headers["Location"]
        await self.peer.setRemoteDescription(aiortc.RTCSessionDescription(text, "answer"))


@asynccontextmanager
async def sending(url: str, track: Canvas, codec: str = "video/VP8") -> AsyncIterator[Sender]:
    """A camera that sends, and hangs up at the end."""
    sender = Sender(url, track, codec)
    try:
        async with aiohttp.ClientSession() as session:
            await sender.start(session)
        yield sender
    finally:
        await sender.peer.close()
