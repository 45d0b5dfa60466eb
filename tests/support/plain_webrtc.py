"""The peer of tests/bench/bench_viewfinder.py: a video file sent as aiortc sends it, an encoder for each viewer, nothing laid over."""

import asyncio
import json
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from fractions import Fraction
from pathlib import Path
from threading import Event, Thread
from typing import Any

import av
from aiohttp import web
from aiortc import RTCConfiguration, RTCPeerConnection, RTCRtpSender, RTCSessionDescription
from aiortc.mediastreams import MediaStreamTrack

from tests.support.streaming_viewers import serving_routes
from viewfinder.frames import CameraFrame
from viewfinder.sources.frame_source import SizeLimit
from viewfinder.sources.playback import VideoFileSource

_TICKS_PER_S = 90_000


class NewestFrames:
    """A file played in a thread; who waits is woken in the loop."""

    def __init__(self, path: Path, width_px: int, height_px: int) -> None:
        self._source, self._stopping = VideoFileSource(path, SizeLimit(width_px, height_px)), Event()
        self._loop, self.frame = asyncio.get_running_loop(), asyncio.get_running_loop().create_future()
        self._thread = Thread(target=self._run, name="capture", daemon=True)
        self._thread.start()

    def _run(self) -> None:
        for frame in self._source.frames(self._stopping):
            self._loop.call_soon_threadsafe(self._set, frame)

    def _set(self, frame: CameraFrame) -> None:
        waited, self.frame = self.frame, self._loop.create_future()
        waited.set_result(frame)

    async def close(self) -> None:
        self._stopping.set()
        await asyncio.to_thread(self._thread.join)


class PlainTrack(MediaStreamTrack):
    """Tells over a channel what each picture's timestamp means, as our viewers expect it."""

    kind = "video"

    def __init__(self, frames: NewestFrames) -> None:
        super().__init__()
        self._frames, self.channel = frames, None

    async def recv(self) -> Any:
        shown: CameraFrame = await asyncio.shield(self._frames.frame)
        picture = av.VideoFrame.from_ndarray(shown.bgr, "bgr24")
        picture.pts, picture.time_base = round(shown.captured_s * _TICKS_PER_S), Fraction(1, _TICKS_PER_S)
        if self.channel is not None and self.channel.readyState == "open":
            status = {"sequence": shown.sequence, "captured_ms": 1000 * shown.captured_s, "rtp_timestamp": picture.pts % 2**32}
            self.channel.send(json.dumps(status))
        return picture


@asynccontextmanager
async def plain_stream(path: Path, width_px: int, height_px: int) -> AsyncIterator[str]:
    """The address of a server whose /whep answers offers."""
    frames, peers = NewestFrames(path, width_px, height_px), list[RTCPeerConnection]()

    async def offered(request: web.Request) -> web.Response:
        peer, track = RTCPeerConnection(RTCConfiguration(iceServers=[])), PlainTrack(frames)
        peers.append(peer)
        peer.on("datachannel", lambda channel: setattr(track, "channel", channel))
        transceiver = peer.addTransceiver(track, "sendonly")
        transceiver.setCodecPreferences([each for each in RTCRtpSender.getCapabilities("video").codecs if each.mimeType == "video/H264"])
        await peer.setRemoteDescription(RTCSessionDescription(await request.text(), "offer"))
        await peer.setLocalDescription()
        return web.Response(status=201, text=peer.localDescription.sdp, content_type="application/sdp", headers={"Location": "/whep/1"})

    async with serving_routes([web.post("/whep", offered)]) as url:
        try:
            yield url
        finally:
            await asyncio.gather(*(peer.close() for peer in peers))
            await frames.close()
