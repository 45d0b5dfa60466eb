"""JpegStream: a FrameSink that encodes each picture once, in a thread of its own, for all WebSockets that wait for one.

A message of the stream is a 4-byte big-endian length, a JSON header of that length, and a JPEG.

The client sends {"ack": sequence} when it has shown a picture, and only then gets another one: the newest there is. {"clock": t} comes
back as {"clock": t, "server_ms": now}, so that the client can tell how old a picture is in its own time. Everything else is a control
message and answered as POST /control answers it.
"""

import asyncio
import json
import logging
import struct
import time
from collections.abc import Callable
from contextlib import suppress
from threading import Event, Lock, Thread
from typing import Any

from aiohttp import WSMsgType, web

from viewfinder.frames import Newest, OutputFrame, frame_header, without_folders
from viewfinder.server.access import LARGEST_MESSAGE, Access, error, json_value
from viewfinder.server.controls import Dispatcher
from viewfinder.server.sessions import RateLimit, Role


class Broadcaster:
    """Hand-over of messages to WebSockets. `open` binds it to the running event loop; `publish` and `fail` may come from any thread."""

    def __init__(self) -> None:
        self._loop: asyncio.AbstractEventLoop | None = None
        self._waiting: set[asyncio.Future[bytes]] = set()
        self._farewells: set[asyncio.Task[None]] = set()
        self.sockets: set[web.WebSocketResponse] = set()
        self.failure: str | None = None

    def open(self) -> None:
        self._loop = asyncio.get_running_loop()

    async def close(self) -> None:
        """Tell every socket that the viewfinder was stopped."""
        for socket in list(self.sockets):
            await socket.close(code=1001, message=b"the viewfinder was stopped")

    @property
    def waited_for(self) -> bool:
        """Whether somebody waits; from any thread."""
        return bool(self._waiting)

    async def next_message(self) -> bytes:
        """Return the next message that is published after this call."""
        future: asyncio.Future[bytes] = asyncio.get_running_loop().create_future()
        self._waiting.add(future)
        try:
            return await future
        finally:
            self._waiting.discard(future)

    def publish(self, message: bytes) -> None:
        # A picture again: the source came back.
        self.failure = None
        self._in_loop(self._publish, message)

    def fail(self, sentence: str) -> None:
        """Tell whoever is here, and whoever comes later, that the source died."""
        self.failure = sentence
        self._in_loop(self._fail, sentence)

    async def tell_failure(self, socket: web.WebSocketResponse) -> None:
        if self.failure is not None and not socket.closed:
            await socket.send_json({"failure": self.failure})

    def _in_loop(self, function: Callable[[Any], None], argument: Any) -> None:
        if self._loop is not None:
            # The loop may end at any moment while a thread still has news.
            with suppress(RuntimeError):
                self._loop.call_soon_threadsafe(function, argument)

    def _publish(self, message: bytes) -> None:
        waiting, self._waiting = self._waiting, set()
        for future in waiting:
            if not future.done():
                future.set_result(message)

    def _fail(self, _sentence: str) -> None:
        for socket in self.sockets:
            farewell = asyncio.ensure_future(self.tell_failure(socket))
            self._farewells.add(farewell)
            farewell.add_done_callback(self._farewells.discard)


_POLL_S = 0.1

log = logging.getLogger(__name__)


class JpegStream:
    """FrameSink that runs until `close`, or the end of a `with`. broadcaster: hands messages and failures to the sockets."""

    def __init__(self, jpeg_quality: int = 85) -> None:
        self.broadcaster = Broadcaster()
        self._jpeg_quality = jpeg_quality
        self._newest: Newest[tuple[OutputFrame, int]] = Newest()
        # A picture that was shown before a failure must not be published after it: it would say that all is well again.
        self._failures, self._telling = 0, Lock()
        self._encoding, self._stopping = Event(), Event()
        self._thread = Thread(target=self._work, name="jpeg", daemon=True)
        self._thread.start()

    @property
    def wants_frame(self) -> bool:
        """Whether a viewer waits whom the picture at hand will not reach."""
        return self.broadcaster.waited_for and not self._encoding.is_set() and not self._newest.waiting

    def show(self, frame: OutputFrame) -> None:
        self._newest.put((frame, self._failures))

    def fail(self, sentence: str) -> None:
        with self._telling:
            self._failures += 1
            self.broadcaster.fail(without_folders(sentence))

    def __enter__(self) -> "JpegStream":
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def close(self) -> None:
        """End the thread; sockets get nothing more."""
        self._stopping.set()
        self._thread.join()

    def _work(self) -> None:
        while not self._stopping.is_set():
            shown = self._newest.take(_POLL_S)
            if shown is None or not self.broadcaster.waited_for:
                continue
            self._encoding.set()
            try:
                self._publish(*shown)
            except Exception:
                log.exception("a picture could not be encoded")
            finally:
                self._encoding.clear()

    def _publish(self, frame: OutputFrame, failures: int) -> None:
        """Encode a picture, and hand it out unless the source failed since it was shown. failures: how many there were then."""
        message = jpeg_message(frame, self._jpeg_quality)
        with self._telling:
            if failures == self._failures:
                self.broadcaster.publish(message)


def jpeg_message(frame: OutputFrame, jpeg_quality: int) -> bytes:
    """Return a message of the stream; the time of the encoding is the last of its stages."""
    import cv2

    started_s = time.perf_counter()
    jpeg = cv2.imencode(".jpg", frame.bgr, [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality])[1].tobytes()
    header = frame_header(frame)
    header["stages_ms"]["jpeg"] = round(1000 * (time.perf_counter() - started_s), 2)
    return packed(header, jpeg)


def packed(header: dict[str, Any], jpeg: bytes) -> bytes:
    """Return the length of the header, the header and the JPEG as bytes."""
    encoded = json.dumps(header).encode()
    return struct.pack(">I", len(encoded)) + encoded + jpeg


_MOST_SOCKETS = 16


class JpegSocket:
    """Handler of GET /stream. Sockets beyond 16 are refused; one that floods is closed."""

    def __init__(self, broadcaster: Broadcaster, dispatcher: Dispatcher, access: Access) -> None:
        self._broadcaster, self._dispatcher, self._access = broadcaster, dispatcher, access
        # Twice what a screen of 120 Hz acknowledges.
        self._limit = RateLimit(per_s=240.0, burst=480.0)

    async def handle(self, request: web.Request) -> web.StreamResponse:
        if len(self._broadcaster.sockets) >= _MOST_SOCKETS:
            return error(f"{_MOST_SOCKETS} viewers watch already: close one of them", 503)
        # Pictures are compressed already; another compression would only cost time.
        socket = web.WebSocketResponse(max_msg_size=LARGEST_MESSAGE, heartbeat=10.0, compress=False)
        await socket.prepare(request)
        self._broadcaster.sockets.add(socket)
        credit = asyncio.Event()
        credit.set()
        sender = asyncio.create_task(self._send(socket, credit))
        try:
            await self._broadcaster.tell_failure(socket)
            await self._receive(socket, request, credit)
        finally:
            self._broadcaster.sockets.discard(socket)
            sender.cancel()
            await asyncio.gather(sender, return_exceptions=True)
        return socket

    async def _receive(self, socket: web.WebSocketResponse, request: web.Request, credit: asyncio.Event) -> None:
        async for message in socket:
            if not self._limit.allows(request.remote or ""):
                await socket.close(code=1008, message=b"too many messages")
            elif message.type is WSMsgType.TEXT:
                answer = await self._answer(message.data, request, credit)
                if answer is not None:
                    await socket.send_json(answer)

    async def _answer(self, text: str, request: web.Request, credit: asyncio.Event) -> dict[str, Any] | None:
        match json_value(text):
            case {"ack": int(), **rest} if not rest:
                credit.set()
                return None
            case {"clock": int() | float() as asked, **rest} if not rest:
                return {"clock": asked, "server_ms": 1000 * time.monotonic()}
        return await self._dispatcher.answer(text, self._access.role(request) or Role.VIEW, request.remote or "")

    async def _send(self, socket: web.WebSocketResponse, credit: asyncio.Event) -> None:
        """Send one picture per credit, always the newest."""
        while not socket.closed:
            await credit.wait()
            credit.clear()
            await socket.send_bytes(await self._broadcaster.next_message())
